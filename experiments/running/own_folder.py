"""A folder of its own for every run and every sweep, also of those that begin within one second."""

from itertools import count
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, read_write

# A folder that ends with anything else is the user's choice, who may mean one that is there.
_MOMENT = "${now:%Y-%m-%d_%H-%M-%S}"


class OwnFolder(Callback):
    """Makes the folder of a run before the run begins.

    Where another one has made it within the same second, this one's name ends with `_2`, and so on.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make the folder of a run.

        Args:
            config: of the run.
            kwargs: what else Hydra tells.
        """
        _make(config, config.hydra.run)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make the folder of a sweep.

        Args:
            config: of the sweep.
            kwargs: what else Hydra tells.
        """
        _make(config, config.hydra.sweep)


def _make(config: DictConfig, place: DictConfig) -> None:
    written = OmegaConf.to_container(place, resolve=False)["dir"]
    if not written.endswith(_MOMENT):
        return
    before = HydraConfig.instance().cfg
    HydraConfig.instance().cfg = config
    try:
        for number in count(1):
            with read_write(place):
                # What else the folder's name refers to stays: jobs may be of several experiments.
                place.dir = written + (f"_{number}" if number > 1 else "")
            try:
                Path(place.dir).mkdir(parents=True)
            except FileExistsError:
                continue
            return
    except OSError:
        return  # Hydra makes the folder again, and names what is wrong
    finally:
        HydraConfig.instance().cfg = before
