"""Hydra's basic launcher gives way to one that goes on with a sweep that was stopped."""

from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, read_write

_BASIC = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_OWN = "hydra_plugins.dolens_launchers.SerialLauncher"


class OwnBasicLauncher(Callback):
    """Puts dolens's launcher in the place of Hydra's basic one, before a sweep begins.

    A file of the configuration cannot do so: Hydra keeps the name `basic` for its own, and another
    default would win over the launcher that a file of `search` chooses.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Replace the launcher.

        Args:
            config: of the sweep.
            kwargs: what else Hydra tells.
        """
        if config.hydra.launcher.get("_target_") == _BASIC:
            with read_write(config.hydra.launcher):
                config.hydra.launcher._target_ = _OWN
