"""Settings of Lightning's trainer that it takes without a word, and stumbles over later."""

from collections.abc import Mapping
from typing import Any

from dolens.experiments.checks import check_count

# The least that each may be; -1 of some means all, or no end.
_LEAST = {
    "max_epochs": -1,
    "check_val_every_n_epoch": 1,
    "log_every_n_steps": 0,
    "num_sanity_val_steps": -1,
}


def check_trainer(settings: Mapping[str, Any]) -> None:
    """Refuse counts that a trainer cannot work with.

    Args:
        settings: of `lightning.Trainer`; what is not there or null is Lightning's own.

    Raises:
        InputError: the first that is no integer, or too small.
    """
    for key, least in _LEAST.items():
        if settings.get(key) is not None:
            check_count(f"trainer.{key}", settings[key], least)
