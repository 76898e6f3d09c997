"""The gain of restored images over simpler pictures of the same photographs, with its interval."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch

from dolens.experiments.camera.photograph_scores import (
    PhotographScores,
    format_interval,
    statistics_of,
)
from dolens.experiments.camera.untrained_rivals import RIVALS
from dolens.reconstruction.quality import Interval, gain_interval

# Gains by their names: over which scores of the same test they are, and what those are of.
OVER = {
    "gain_over_filter_db": ("linear_psnr_db", "the network's own linear filter"),
    "gain_over_raw_db": ("raw_psnr_db", "the sensor's image"),
    "gain_over_plain_db": ("plain_psnr_db", "the plain lens in one exposure, restored alike"),
    **{f"gain_over_{name}_db": (f"{name}_psnr_db", said) for name, said in RIVALS.items()},
}


class RestorationGain(NamedTuple):
    """The PSNR of restored images less that of simpler pictures, dB.

    Attributes:
        name: in `OVER`.
        view: its label, `worst`, or empty for the mean.
        interval: 95 %, over photographs, paired.
    """

    name: str
    view: str
    interval: Interval


def restoration_gains(scores: PhotographScores, views: Sequence[str]) -> Iterator[RestorationGain]:
    """Yield the gains of one test.

    At the worst view the gain is that of the worst view of either: they may be two.

    Args:
        scores: of the test.
        views: labels, `worst`, or empty for the mean over the views; see `statistics_of`.
    """
    statistics = statistics_of(scores.views)
    for name, (other, _) in OVER.items():
        if other not in scores.metrics:
            continue
        sides = [scores.metrics[metric].double()[None] for metric in ("psnr_db", other)]
        for view in views:
            interval = gain_interval(*sides, statistics[view], torch.Generator().manual_seed(0))
            yield RestorationGain(name, view, interval)


def gain_numbers(scores: PhotographScores, stage: str) -> dict[str, float]:
    """Return gains and the ends of their intervals, by the names of metrics: of the mean over the
    views, each view, and the worst.
    """
    numbers = {}
    for gain in restoration_gains(scores, list(statistics_of(scores.views))):
        key = f"{stage}/{gain.name}" + (f"/{gain.view}" if gain.view else "")
        found = gain.interval
        numbers |= {key: found.estimate}
        numbers |= {f"error/{key}/low": found.low, f"error/{key}/high": found.high}
    return numbers


def gain_line(scores: PhotographScores) -> str:
    """Return a sentence that says the gains at the worst view, with their intervals."""
    said = [
        f"{format_interval(gain.interval, 2)} dB over {OVER[gain.name][1]}"
        for gain in restoration_gains(scores, ["worst"])
    ]
    return (
        f"Restored images at the worst of {', '.join(scores.views)}: {'; '.join(said)} "
        f"({len(scores.photographs)} photographs, 95 % intervals)"
    )


def behind_line(scores: PhotographScores) -> str | None:
    """Return a sentence that says which untrained restorers are ahead at the worst view, if any."""
    ahead = [
        f"{format_interval(gain.interval, 2)} dB over {OVER[gain.name][1]}"
        for gain in restoration_gains(scores, ["worst"])
        if gain.name in {f"gain_over_{name}_db" for name in RIVALS} and gain.interval.estimate < 0.0
    ]
    return f"The network is behind untrained restorers: {'; '.join(ahead)}" if ahead else None
