"""Arithmetic that configurations need, as resolvers of OmegaConf: `${total_steps:6,50}`."""

from typing import Any

from omegaconf import OmegaConf

from dolens.experiments.checks import check_count


def total_steps(epochs: Any, batches: Any, batches_of_step: Any = 1) -> int:
    """Return the steps of a whole training, each of some batches.

    Args:
        epochs: `trainer.max_epochs`.
        batches: of an epoch, `data.steps_per_epoch`.
        batches_of_step: `trainer.accumulate_grad_batches`.

    Raises:
        InputError: one of them is no number that a schedule could end by.
    """
    check_count("trainer.max_epochs", epochs, 0)
    check_count("data.steps_per_epoch", batches)
    check_count("trainer.accumulate_grad_batches", batches_of_step)
    return epochs * batches // batches_of_step


_RESOLVERS = {
    "total_steps": total_steps,
    # The iterations of all stages together.
    "iterations": lambda stages: sum(stage["iterations"] for stage in stages),
    "count": len,
    "given": bool,
    # The pixels on each side of the middle of a window with an odd number of them.
    "margin_of": lambda size: size // 2,
}


def register_resolvers() -> None:
    """Make the resolvers known to OmegaConf; a second call changes nothing."""
    for name, resolver in _RESOLVERS.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
