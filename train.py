"""The one entry point: `python train.py experiment=<name> [key=value ...]`."""

import os
import sys

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError
from dolens.experiments.running.renaming import explained
from dolens.experiments.running.training import run


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> float:
    """Run the composed experiment and return its objective."""
    try:
        return run(cfg)
    except (InputError, HydraException, OmegaConfBaseException) as error:
        # Hydra reports a class that could not be made; the reason is what the user can mend.
        # Exiting here, within the job, keeps Hydra from adding lines of its own.
        sys.exit(one_line(error.__cause__ if isinstance(error.__cause__, InputError) else error))


def one_line(problem: object) -> str:
    """The message of a user's mistake, on one line."""
    return "error: " + " ".join(str(problem).split())


if __name__ == "__main__":
    # Let errors through to here: a user's mistake is one line, a fault keeps its whole traceback.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    if {"--help", "-h"} & set(sys.argv) and not any("experiment=" in a for a in sys.argv):
        sys.argv.append("~experiment")  # what there is to choose from can be shown without a choice
    try:
        main()
    except HydraException as error:
        sys.exit(one_line(explained(error, sys.argv[1:])))
    except OmegaConfBaseException as error:
        sys.exit(one_line(error))
