"""Arithmetic that configurations need, as resolvers of OmegaConf: `${total_steps:6,50}`."""

from omegaconf import OmegaConf

_RESOLVERS = {
    # The steps of a whole training, each of some batches.
    "total_steps": lambda epochs, batches, batches_of_step=1: epochs * batches // batches_of_step,
    # The iterations of all stages together.
    "iterations": lambda stages: sum(stage["iterations"] for stage in stages),
    "count": len,
    # The pixels on each side of the middle of a window with an odd number of them.
    "margin_of": lambda size: size // 2,
}


def register_resolvers() -> None:
    """Make the resolvers known to OmegaConf; a second call changes nothing."""
    for name, resolver in _RESOLVERS.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
