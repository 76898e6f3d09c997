"""Whether more of a metric is better, by its name."""

import re
from collections.abc import Sequence

from dolens.errors import InputError, check_choice

MAXIMIZE, MINIMIZE = "maximize", "minimize"
DIRECTIONS = (MAXIMIZE, MINIMIZE)
# As Lightning's checkpoints have them.
BY_MODE = {"max": MAXIMIZE, "min": MINIMIZE}
# Words of the last parts of metrics' names.  An error of a quality, or a cost, is an error or a
# cost first: those stand above.
_SMALLER = {
    *("cost", "error", "loss", "merit", "rms", "tolerance", "pose", "bound", "bounds"),
    *("knowledge", "failed", "vignetted", "iterations", "parameters", "track", "distortion"),
}
_LARGER = {
    *("psnr", "ssim", "mtf", "modulation", "strehl", "encircled", "converged", "right"),
    *("probability",),
}


def direction_of(metric: str) -> str | None:
    """Return `maximize` or `minimize`; None where the name does not tell.

    Args:
        metric: as `test/psnr_db/worst`, `rms_spot_um/final` or `cost/step_s`.
    """
    words = set(re.split(r"[/_]", metric.lower()))
    if words & _SMALLER:
        return MINIMIZE
    return MAXIMIZE if words & _LARGER else None


def directions_of(metrics: Sequence[str], given: Sequence[str] | None) -> list[str]:
    """Return the direction of each objective of a search.

    Args:
        metrics: names of the objectives.
        given: what the user says, one word for each; None: by the names.

    Raises:
        InputError: a word that is no direction, another number of them than of objectives, or a
            metric whose name does not tell.
    """
    key = "hydra.sweeper.directions"
    if given is not None:
        for word in given:
            check_choice(word, DIRECTIONS, key)
        if len(given) != len(metrics):
            raise InputError(
                f"{key}: {len(given)} for {len(metrics)} objectives ({', '.join(metrics)})"
            )
        return list(given)
    return [_known(metric, key) for metric in metrics]


def _known(metric: str, key: str) -> str:
    direction = direction_of(metric)
    if direction is None:
        raise InputError(
            f"{key}: whether more of '{metric}' is better does not follow from its name; give "
            f"{key}=[maximize] or [minimize], one for each objective"
        )
    return direction
