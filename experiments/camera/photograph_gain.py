"""The gain of one camera over another, paired over the photographs that both were tested with."""

from collections.abc import Sequence

import torch

from dolens.experiments.camera.photograph_scores import PhotographScores, statistics_of
from dolens.reconstruction.quality import Interval, gain_interval


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
