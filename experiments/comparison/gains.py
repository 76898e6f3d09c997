"""What a row gains over another one, paired over seeds and photographs."""

import statistics
from collections.abc import Mapping

from dolens.experiments.camera.photograph_gain import paired_gain
from dolens.experiments.comparison.rows import Row
from dolens.experiments.comparison.run import Run
from dolens.reconstruction.quality import Interval


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
    if view is not None:
        scores = ([run.scores for run in side] for side in runs)
        found = paired_gain(*scores, metric, view)
        if found is not None:
            return found
    means = [statistics.mean(run.metrics[key] for run in side) for side in runs]
    return Interval(means[0] - means[1], float("nan"), float("nan"), len(seeds), 0)
