"""A composed configuration, checked before any work is done."""

from omegaconf import DictConfig, OmegaConf

from dolens.experiments.running.dropped_entries import without_dropped
from dolens.experiments.running.renaming import refuse_renamed
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.target_keys import (
    refuse_missing,
    refuse_targets_in_lenses,
    refuse_unknown_keys,
)
from dolens.experiments.running.unread_settings import refuse_unread
from dolens.experiments.running.value_types import refuse_wrong_types

# What Hydra makes; the lens is made by `dolens.prescriptions`, from data alone.
_MADE = ("module", "data", "callbacks", "logger", "trainer")


def checked(cfg: DictConfig) -> DictConfig:
    """Return the configuration that a run works with.

    It is the composed one without Hydra's own part, and without the entries that an experiment
    drops.

    Args:
        cfg: as Hydra gives it to the job; it stays as it is.

    Raises:
        InputError: an old name, an entry dropped that no parent has, a `_target_` in a lens, a key
            that a class does not take, a setting that is missing, a value of another type than the
            class takes, or a setting that nothing reads.
    """
    own = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    refuse_renamed(own)
    own = without_dropped(own)
    plain = OmegaConf.to_container(own, resolve=False)
    refuse_targets_in_lenses(plain)
    refuse_unknown_keys(plain, _MADE)
    refuse_missing(plain, _MADE)
    refuse_wrong_types(plain, _MADE)
    refuse_unread(own, RunSettings.names())
    return own
