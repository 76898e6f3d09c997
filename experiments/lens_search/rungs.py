"""Successive halving: forms of a search become cameras, and the better ones train on."""

import math
import os
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError, check_count
from dolens.experiments.camera.photograph_scores import PhotographScores, paired_gain, read_scores
from dolens.experiments.lens_search.trained_camera import TrainedCamera, stage_of
from dolens.experiments.tables import read_table
from dolens.prescriptions import load_lens
from dolens.reconstruction.quality import Interval


@dataclass(frozen=True)
class Halving:
    """Says how much each rung trains, and how many go on.

    The first rung trains all candidates for `first_epochs`, each later one `factor` times as many
    in all, and one of `factor` candidates goes on.

    Args:
        rungs: how many there are; 1 trains all to the end.
        factor: see above.
        first_epochs: of the first rung.
        least: candidates that reach the last rung, where there are as many.

    Raises:
        InputError: a number is too small.
    """

    rungs: int
    factor: int
    first_epochs: int
    least: int = 1

    def __post_init__(self) -> None:
        check_count("halving.rungs", self.rungs)
        check_count("halving.factor", self.factor, 2)
        check_count("halving.first_epochs", self.first_epochs)
        check_count("halving.least", self.least)

    @property
    def epochs(self) -> tuple[int, ...]:
        """Return the epochs that each rung ends with."""
        return tuple(self.first_epochs * self.factor**rung for rung in range(self.rungs))

    def survivors(self, scores: Mapping[str, float], always: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the candidates that go on, the best first.

        Args:
            scores: of each candidate; more is better, NaN is worst.
            always: candidates that go on whatever their scores are, besides the others.

        Raises:
            InputError: there are no candidates.
        """
        if not scores:
            raise InputError("halving: there is no candidate left")
        ranked = sorted(scores, key=lambda name: -_number(scores[name]))
        count = min(len(ranked), max(self.least, math.ceil(len(ranked) / self.factor)))
        return tuple(name for name in ranked if name in ranked[:count] or name in always)


def _number(score: float) -> float:
    return -math.inf if math.isnan(score) else score


@dataclass(frozen=True)
class RungOfForm:
    """Holds what a form reached in a rung, by all its seeds.

    Attributes:
        form: its name.
        cameras: one a seed.
        score: that decides, as `psnr_db`, its metric and its view.
    """

    form: str
    cameras: tuple[TrainedCamera, ...]
    score: str

    @property
    def failed(self) -> str:
        """Return why a seed failed, the first that did; empty where none did."""
        return next((camera.failed for camera in self.cameras if camera.failed), "")

    def mean(self, metric: str) -> float:
        """Return the mean of a metric over the seeds; NaN where one has none."""
        values = [camera.metrics.get(metric, float("nan")) for camera in self.cameras]
        return statistics.fmean(values)

    def deviation(self, metric: str) -> float:
        """Return the standard deviation of a metric over the seeds; NaN of one."""
        values = [camera.metrics.get(metric, float("nan")) for camera in self.cameras]
        return statistics.stdev(values) if len(values) > 1 else float("nan")

    @property
    def decides(self) -> float:
        """Return the mean of the score on validation photographs."""
        return self.mean(f"val/{self.score}")

    def scores(self, stage: str) -> list[PhotographScores | None]:
        """Return the scores of each seed by photograph."""
        return [read_scores(camera.task.folder, stage) for camera in self.cameras]

    def gain(self, other: "RungOfForm", stage: str) -> Interval | None:
        """Return the gain over another form, with its interval over photographs and seeds."""
        metric, _, view = self.score.partition("/")
        return paired_gain(self.scores(stage), other.scores(stage), metric, view)


@dataclass(frozen=True)
class Rung:
    """Holds a rung.

    Attributes:
        number: from 1.
        epochs: of training, in all.
        forms: by name, those that were trained.
        going_on: names of those that go on, the best first; of the last rung, all in that order.
    """

    number: int
    epochs: int
    forms: Mapping[str, RungOfForm]
    going_on: tuple[str, ...]

    @property
    def stage(self) -> str:
        """Return the stage of its validation."""
        return stage_of(self.epochs)

    @property
    def best(self) -> RungOfForm:
        """Return the best form."""
        return self.forms[self.going_on[0]]


def forms_of(
    cameras: Sequence[TrainedCamera], names: Sequence[str], score: str
) -> dict[str, RungOfForm]:
    """Return the cameras of a rung by their forms."""
    return {
        name: RungOfForm(name, tuple(c for c in cameras if c.task.form == name), score)
        for name in names
    }


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Return Spearman's rank correlation; NaN of fewer than three pairs, or of equal numbers."""
    if len(one) < 3 or len(set(one)) == 1 or len(set(other)) == 1:
        return float("nan")
    # SciPy's statistics take 0.3 s to load, which a run without a search need not wait for.
    from scipy.stats import spearmanr

    return float(spearmanr(one, other).statistic)


_MM = 1e3  # µm
_TABLE = "forms.csv"
# The middles of five zones of equal area of a square, as shares of half its diagonal.
_ZONES = (0.25, 0.44, 0.56, 0.67, 0.79)


@dataclass(frozen=True)
class SearchedForm:
    """A form of a search.

    Attributes:
        name: as `form_03`.
        file: the prescription.
        text: what the file holds.
        rms_spot_um: µm, the mean of the RMS spot radii over the lens's own fields, all its
            wavelengths together.
        rms_spot_um_by_area: µm, the same over a square sensor whose corners are the largest field:
            each part of it counts as its area does.
    """

    name: str
    file: Path
    text: str
    rms_spot_um: float
    rms_spot_um_by_area: float


def forms_of_run(folder: str | Path, most: int) -> tuple[SearchedForm, ...]:
    """Return the forms of a search that keep every check, the least spots first.

    Args:
        folder: the run folder of a search.
        most: forms that are returned.

    Raises:
        InputError: the folder holds no forms, or none that keeps every check.
    """
    folder = Path(folder)
    files = sorted((folder / "forms").glob("form_*.yaml"))
    if not files:
        raise InputError(
            f"{folder}: has no forms/form_*.yaml; name the run folder of a search that found lenses"
        )
    kept = _that_hold(folder / _TABLE)
    forms = [_form(file) for file in files if kept is None or file.stem in kept]
    if not forms:
        raise InputError(f"{folder}: no form keeps every check of the search (see {_TABLE})")
    return tuple(sorted(forms, key=lambda form: form.rms_spot_um)[:most])


def _that_hold(table: Path) -> set[str] | None:
    """Return the names of the forms that keep every check; None where no table says so."""
    if not os.path.lexists(table):
        return None
    rows = read_table(table, ("form", "holds"))
    return {row["form"] for row in rows if row["holds"] == "True"}


@torch.no_grad()
def _form(file: Path) -> SearchedForm:
    lens = load_lens(file, dtype=torch.float64)
    own = conditions(lens)
    largest = math.tan(math.radians(float(own.fields.norm(dim=1).max())))
    zones = [(0.0, math.degrees(math.atan(share * largest))) for share in _ZONES]
    spots, by_area = (
        _MM * float(shares @ spot_diagram(lens, own.at(fields)).polychromatic_rms)
        for fields, shares in (
            (own.fields, own.field_weights),
            (zones, own.field_weights.new_full((len(zones),), 1.0 / len(zones))),
        )
    )
    return SearchedForm(file.stem, file, file.read_text(encoding="utf-8"), spots, by_area)
