"""A script composes the configuration as `train.py` does, from the checkout's own files."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

CONF = Path(__file__).resolve().parents[1] / "conf"


@contextmanager
def composed(overrides: Sequence[str]) -> Iterator[DictConfig]:
    """Give the configuration of some overrides; what it names may be instantiated within.

    Args:
        overrides: of `train.py`, `experiment=` among them.
    """
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", list(overrides), return_hydra_config=True)
        HydraConfig.instance().set_config(cfg)
        yield cfg
