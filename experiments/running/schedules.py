"""Settings of PyTorch's schedules that it takes without a word, and stumbles over later."""

from collections.abc import Mapping
from typing import Any

from dolens.experiments.checks import check_count, check_not_negative, check_positive

_COUNTS = ("T_max", "T_0", "T_mult", "step_size", "total_iters", "total_steps", "step_size_up")
_RATES = ("eta_min", "min_lr", "base_lr")
_POSITIVE = ("gamma", "max_lr")


def check_schedule(path: str, settings: Mapping[str, Any]) -> None:
    """Refuse lengths and learning rates that a schedule cannot work with.

    Args:
        path: of the schedule; messages begin with it.
        settings: those that are known; null is PyTorch's own.

    Raises:
        InputError: a length that is no positive integer, or a rate that is negative or no number.
    """
    for keys, check in (
        (_COUNTS, check_count),
        (_RATES, check_not_negative),
        (_POSITIVE, check_positive),
    ):
        for key in keys:
            if settings.get(key) is not None and not isinstance(settings[key], list):
                check(f"{path}.{key}", settings[key])
