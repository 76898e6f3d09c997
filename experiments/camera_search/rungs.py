"""Rungs of successive halving: cameras are trained, compared, and the better ones go on."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dolens.experiments.camera.photograph_gain import paired_gain
from dolens.experiments.camera.photograph_scores import PhotographScores, read_scores
from dolens.experiments.camera_search.rung_callbacks import stage_of
from dolens.experiments.camera_search.trained_camera import TrainedCamera
from dolens.reconstruction.quality import Interval


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
    return statistics.correlation(_ranks(one), _ranks(other))


def _ranks(values: Sequence[float]) -> list[float]:
    """Return ranks from 1; equal values share theirs."""
    ordered = sorted(values)
    return [ordered.index(v) + 0.5 * (ordered.count(v) + 1) for v in values]
