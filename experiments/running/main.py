"""From the arguments of a command line to runs: Hydra composes the configuration of each."""

import logging
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.command_line import explained, no_choice, prepared
from dolens.experiments.running.faults import machine_fault, reason_of, thread_faults_in_one_line
from dolens.experiments.running.trainer import own_arguments, report_failure
from dolens.experiments.running.training import run
from dolens.experiments.running.user_configuration import make_importable, use_working_folder
from dolens.experiments.search.pruning import TrialPruned
from dolens.files import packaged_configuration

logger = logging.getLogger(__name__)


def main(arguments: Sequence[str], program: str) -> None:
    """Run what the arguments ask for: one run, a sweep (`-m`), or another option of Hydra's.

    Args:
        arguments: overrides and options, as Hydra takes them.
        program: how the user called it, as `dolens train` or `train.py`; messages repeat it.

    Raises:
        SystemExit: with one line that names a user's mistake.
    """
    # Let errors through to here: a user's mistake is one line, a fault keeps its whole traceback.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    use_working_folder()
    start = hydra.main(str(packaged_configuration()), "train", version_base="1.3")(job)
    try:
        sys.argv = [program]  # Hydra's parser of options is named by it
        arguments = prepared(arguments, program)
        with own_arguments(arguments) as own:
            sys.argv = [program, *own]
            start()
    except HydraException as error:
        sys.exit(f"error: {one_line(explained(error))}")
    except (InputError, OmegaConfBaseException) as error:
        sys.exit(f"error: {one_line(error)}")
    except (OSError, ValueError) as error:  # as Hydra makes the folder of a run, and its log
        fault = machine_fault(error) or no_choice(arguments)
        if fault is None:
            raise
        sys.exit(f"error: {fault}")


def job(cfg: DictConfig) -> float | tuple[float, ...]:
    """Run one composed experiment and return its objectives; launchers bring it to processes.

    In a sweep a job that fails does not end the others: it returns NaN, and the sweep's comparison
    names it.  The log of a run that fails ends with the reason.
    """
    make_importable(Path(HydraConfig.get().runtime.cwd))
    swept = HydraConfig.get().mode == RunMode.MULTIRUN
    try:
        with thread_faults_in_one_line():
            return run(cfg)
    except TrialPruned as pruned:
        logger.info("Pruned: %s", pruned)
    except (InputError, HydraException, OmegaConfBaseException) as error:
        told = report_failure(error.__cause__ or error)
        line = reason_of(error, cfg)
        _record(line, to_all=swept)
        if not swept:
            # Exiting here, within the job, keeps Hydra from adding lines of its own.
            sys.exit(1 if told else f"error: {line}")
    except Exception as error:
        if report_failure(error):
            sys.exit(1)
        fault = machine_fault(error)
        line = fault or one_line(f"{type(error).__name__}: {error}")
        _record(line, to_all=swept, with_traceback=True)
        if not swept:
            if fault is not None:
                sys.exit(f"error: {fault}")
            raise
    return math.nan


def _record(line: str, to_all: bool, with_traceback: bool = False) -> None:
    """Write an error into the run's log.txt; to the terminal too, where nothing else would."""
    trace = sys.exc_info() if with_traceback else None
    record = logger.makeRecord(logger.name, logging.ERROR, __file__, 0, line, (), trace)
    for handler in logging.getLogger().handlers:
        if to_all or isinstance(handler, logging.FileHandler):
            handler.handle(record)
