"""The one entry point: `python train.py experiment=<name> [key=value ...]`."""

import os
import sys

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError
from experiments.training import run


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> float:
    """Run the composed experiment and return its objective."""
    return run(cfg)


if __name__ == "__main__":
    # Let errors through to here: a user's mistake is one line, a fault keeps its whole traceback.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        main()
    except (InputError, HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error.__cause__, InputError) else error
        sys.exit("error: " + " ".join(str(cause).split()))
