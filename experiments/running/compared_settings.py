"""Settings of a run as loggers take them, to compare it with others."""

from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from dolens.experiments.running.plain_values import flat

# The groups whose options tell runs from each other.
_COMPARED = (
    *("experiment", "lens", "scene", "renderer", "evaluation_renderer", "views", "readout"),
    *("network", "discriminator", "loss", "optimizer", "data"),
)
# Keys that say where files go, not what is computed.
_PLACES = ("callbacks", "logger", "hydra")


def all_settings(cfg: DictConfig) -> dict[str, Any]:
    """Return all settings of a run as flat plain values."""
    # What `module` holds refers to the other groups and would only repeat them; the others say
    # where files go.
    left_out = ("module", "views", "callbacks", "logger")
    whole = OmegaConf.to_container(cfg, resolve=True)
    leaves = flat({key: value for key, value in whole.items() if key not in left_out})
    return {
        "experiment": HydraConfig.get().runtime.choices.get("experiment"),
        **{name: _plain(leaf) for name, leaf in leaves if leaf != {}},
    }


def choices_of(cfg: DictConfig) -> dict[str, Any]:
    """Return the few settings that tell a run from others.

    These are the experiment and the seed, the options that were chosen, and each key that the
    command line gave or a sweep varied, `lens.*` and `trainer.*` too, with its value.
    """
    hydra = HydraConfig.get()
    options = {
        group: str(option)
        for group, option in hydra.runtime.choices.items()
        if group in _COMPARED and option is not None
    }
    found: dict[str, Any] = {**options, "seed": cfg.seed}
    # As they were typed: `${...}` in one of them is part of its text.
    typed = OmegaConf.to_container(hydra.overrides.task, resolve=False)
    for override in OverridesParser.create().parse_overrides(typed):
        key = override.key_or_group
        if override.is_delete() or key in found or key.partition(".")[0] in _PLACES:
            continue
        value = OmegaConf.select(cfg, key)
        if not OmegaConf.is_config(value):
            found[key] = _plain(value)
        elif OmegaConf.is_list(value) or key not in hydra.runtime.choices:
            found[key] = str(OmegaConf.to_container(value, resolve=True))
        else:
            found[key] = str(hydra.runtime.choices[key])
    return found


def _plain(value: Any) -> bool | int | float | str:
    return value if isinstance(value, bool | int | float | str) else str(value)
