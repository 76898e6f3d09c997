from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, open_dict

from dolens.errors import InputError
from dolens.experiments.running.training import run


@pytest.fixture
def composed(root: Path, tmp_path: Path) -> Iterator[Callable[..., DictConfig]]:
    """Compose an experiment as train.py does, with its run folder under tmp_path."""

    def build(*overrides: str, folder: str = "run") -> DictConfig:
        cfg = compose("train", list(overrides), return_hydra_config=True)
        output = tmp_path / folder
        output.mkdir(exist_ok=True)
        with open_dict(cfg):
            cfg.hydra.runtime.output_dir = str(output)
            cfg.hydra.job.num = 0
        HydraConfig.instance().set_config(cfg)
        return cfg

    with initialize_config_dir(str(root / "conf"), version_base="1.3"):
        yield build
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None


@pytest.fixture
def refused(composed: Callable[..., DictConfig]) -> Callable[..., None]:
    """Run with overrides, and see that it ends by one clear line that says what is expected."""

    def check(expected: str, *overrides: str) -> None:
        with pytest.raises(Exception) as caught:
            run(composed(*overrides))
        error = caught.value.__cause__ or caught.value
        assert isinstance(error, InputError), error
        assert expected in str(error) and "\n" not in str(error)

    return check
