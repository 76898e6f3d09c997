"""What a row gains over another one, paired over seeds and photographs."""

import statistics
from collections.abc import Mapping, Sequence

import torch

from dolens.experiments.camera.photograph_scores import statistics_of
from dolens.experiments.comparison.rows import Row
from dolens.experiments.comparison.run import Run
from dolens.reconstruction.intervals import Interval, gain_interval


def gain_of(row: Row, against: Row, metric: str) -> Interval | None:
    """Return the gain of a row over another one in a metric.

    Args:
        row: which gains.
        against: over which.
        metric: full name; for `test/psnr_db/worst` and the like, scores of photographs pair runs.

    Returns:
        The difference over the seeds that both have, with its 95 % interval over seeds and
        photographs; the interval is NaN where the runs kept no scores of the same photographs.
        None where there is no such seed, or a run has no such metric.
    """
    if metric.startswith("test/"):
        name, _, view = metric.removeprefix("test/").partition("/")
        return gain(row.runs, against.runs, name, view)
    return gain(row.runs, against.runs, metric, None)


def gain(
    group: Mapping[int, Run], against: Mapping[int, Run], metric: str, view: str | None
) -> Interval | None:
    """Return the gain of runs in a view over the seeds that both have; None without such seeds.

    Args:
        group: seed → run.
        against: likewise.
        metric: as `psnr_db`.
        view: as `worst`; empty for the mean over the views; None: `metric` is a full name.
    """
    key = metric if view is None else f"test/{metric}/{view}".rstrip("/")
    seeds = sorted(
        seed
        for seed in group.keys() & against.keys()
        if key in group[seed].metrics and key in against[seed].metrics
    )
    if not seeds:
        return None
    runs = [group[seed] for seed in seeds], [against[seed] for seed in seeds]
    if view is not None and _comparable([*runs[0], *runs[1]], metric, view):
        return gain_interval(
            *(torch.stack([run.scores.metrics[metric] for run in side]) for side in runs),
            statistics_of(runs[0][0].scores.views)[view],
            torch.Generator().manual_seed(0),
        )
    means = [statistics.mean(run.metrics[key] for run in side) for side in runs]
    return Interval(means[0] - means[1], float("nan"), float("nan"), len(seeds), 0)


def _comparable(runs: Sequence[Run], metric: str, view: str) -> bool:
    """Return whether runs kept scores of the same photographs in the same views."""
    first = runs[0].scores
    return (
        first is not None
        and view in statistics_of(first.views)
        and all(
            run.scores is not None
            and (run.scores.photographs, run.scores.views) == (first.photographs, first.views)
            and metric in run.scores.metrics
            for run in runs
        )
    )
