"""Scores of a test by photograph, their intervals, and the gain of one camera over another."""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.tables import Row
from dolens.reconstruction.quality import Interval, bootstrap_interval, gain_interval


def table_name(stage: str = "test") -> str:
    """Return the name of a stage's table in a run folder; a stage is `test` or
    `test_<reference>`.
    """
    return f"{stage}_photographs.csv"


TABLE = table_name()


_SEED = 0  # of resamples: the same run folder gives the same interval


@dataclass(frozen=True)
class PhotographScores:
    """Holds the mean scores over the crops of each photograph.

    Attributes:
        photographs: their names, P.
        crops: crops of each, P.
        views: labels of the views, V.
        metrics: name, as `psnr_db` → scores (P, V).
    """

    photographs: tuple[str, ...]
    crops: tuple[int, ...]
    views: tuple[str, ...]
    metrics: Mapping[str, Tensor]

    def rows(self) -> list[Row]:
        """Return a row for each photograph and view."""
        return [
            {
                "photograph": photograph,
                "crops": self.crops[p],
                "view": view,
                **{name: float(scores[p, v]) for name, scores in self.metrics.items()},
            }
            for p, photograph in enumerate(self.photographs)
            for v, view in enumerate(self.views)
        ]

    def numbers(self, stage: str) -> dict[str, float]:
        """Return counts, and 95 % intervals over photographs: each view, the mean and the worst."""
        numbers = {
            f"{stage}/photographs": float(len(self.photographs)),
            f"{stage}/crops": float(sum(self.crops)),
        }
        for name, scores in self.metrics.items():
            for view, statistic in statistics_of(self.views).items():
                generator = torch.Generator().manual_seed(_SEED)
                found = bootstrap_interval(scores[None], statistic, generator)
                key = f"error/{stage}/{name}" + (f"/{view}" if view else "")
                numbers |= {f"{key}/low": found.low, f"{key}/high": found.high}
        return numbers


def statistics_of(views: Sequence[str]) -> dict[str, Callable[[Tensor], Tensor]]:
    """Return functions of mean scores (R, V): "" for their mean, each view, and `worst`."""
    found: dict[str, Callable[[Tensor], Tensor]] = {"": lambda means: means.mean(dim=-1)}
    for number, view in enumerate(views):
        found[view] = lambda means, number=number: means[..., number]
    return {**found, "worst": lambda means: means.amin(dim=-1)}


def scores_by_photograph(
    scores: Mapping[str, Tensor], photographs: Sequence[str], views: Sequence[str]
) -> PhotographScores:
    """Average scores of crops over each photograph.

    Args:
        scores: metric → scores of crops (N, V).
        photographs: the photograph of each crop, N.
        views: labels of the views.
    """
    names = tuple(dict.fromkeys(photographs))
    of_photograph = {name: [] for name in names}
    for number, name in enumerate(photographs):
        of_photograph[name].append(number)
    return PhotographScores(
        names,
        tuple(len(numbers) for numbers in of_photograph.values()),
        tuple(views),
        {
            metric: torch.stack([of_crops[n].mean(dim=0) for n in of_photograph.values()])
            for metric, of_crops in scores.items()
        },
    )


def read_scores(folder: Path, stage: str = "test") -> PhotographScores | None:
    """Read the table of a run folder; None where there is none.

    Raises:
        InputError: the table is not one that `PhotographScores.rows` gives.
    """
    path = folder / table_name(stage)
    if not path.is_file():
        return None
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        found = {(row.pop("photograph"), row.pop("view")): row for row in rows}
        names = tuple(dict.fromkeys(name for name, _ in found))
        views = tuple(dict.fromkeys(view for _, view in found))
        crops = tuple(int(found[name, views[0]]["crops"]) for name in names)
        metrics = [metric for metric in rows[0] if metric != "crops"]
        tensors = {
            metric: torch.tensor(
                [[float(found[name, view][metric]) for view in views] for name in names],
                dtype=torch.float64,
            )
            for metric in metrics
        }
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"{path}: not a table of scores of photographs ({error!r})") from None
    return PhotographScores(names, crops, views, tensors)


def format_interval(interval: Interval, digits: int) -> str:
    """Format an estimate with its sign and its interval, as `+0.50 [+0.31, +0.72]`."""
    if interval.low != interval.low:
        return f"{interval.estimate:+.{digits}f}"
    low, high = f"{interval.low:+.{digits}f}", f"{interval.high:+.{digits}f}"
    return f"{interval.estimate:+.{digits}f} [{low}, {high}]"


def paired_gain(
    scores: Sequence[PhotographScores | None],
    against: Sequence[PhotographScores | None],
    metric: str,
    view: str,
) -> Interval | None:
    """Return the mean gain with its 95 % interval over photographs, and over seeds if several.

    The resamples are the same at every call.

    Args:
        scores: of the camera whose gain it is, one entry a seed.
        against: of the camera that it is compared with, for the same seeds.
        metric: as `psnr_db`.
        view: the label of a view, as `worst`; empty for the mean over the views.

    Returns:
        None where the runs kept no scores of the same photographs in the same views, or no such
        metric or view.
    """
    if not _comparable([*scores, *against], metric, view):
        return None
    sides = (torch.stack([run.metrics[metric] for run in side]) for side in (scores, against))
    statistic = statistics_of(scores[0].views)[view]
    return gain_interval(*sides, statistic, torch.Generator().manual_seed(0))


def _comparable(scores: Sequence[PhotographScores | None], metric: str, view: str) -> bool:
    """Return whether scores are of the same photographs in the same views, with the metric."""
    first = scores[0]
    return (
        first is not None
        and view in statistics_of(first.views)
        and all(
            run is not None
            and (run.photographs, run.views) == (first.photographs, first.views)
            and metric in run.metrics
            for run in scores
        )
    )
