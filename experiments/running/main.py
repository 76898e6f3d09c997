"""From the arguments of a command line to runs: Hydra composes the configuration of each, and an
error that ends one is explained in one line, as a wrong setting or a fault of the machine.
"""

import errno
import logging
import math
import os
import re
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.data.crop_loading import LostWorkerError
from dolens.experiments.running.command_line import explained, no_choice, prepared
from dolens.experiments.running.refused_settings import REFERENCE, targets
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


_TARGET = re.compile(r"call to target '(?P<name>[^']*)'")
_KEY = re.compile(r"full_key: (?P<key>\S+)")
_NAME = re.compile(r"[\w.]+")
# A message begins with what it is about: a part's name and a setting's.
_SUBJECT = 3


def reason_of(error: BaseException, cfg: DictConfig | None = None) -> str:
    """Return what to say of an error that ends a run, on one line.

    Hydra reports a class that could not be made; the reason is what the user can mend, and where a
    class of others gives it, the setting that makes this class is named.  A class names its own
    arguments; where the configuration gives them by another setting, that is named too.

    Args:
        error: what ended the run.
        cfg: the run's configuration.
    """
    cause = error.__cause__
    if isinstance(cause, InputError):
        return _with_setting(str(cause), cfg)
    if isinstance(error, InputError):
        return _with_setting(str(error), cfg)
    target, key = _TARGET.search(str(error)), _KEY.search(str(error))
    if cause is None or target is None or not isinstance(error, InstantiationException):
        return one_line(error)
    where = key["key"] if key else "configuration"
    name = target["name"].rpartition(".")[2]
    return str(InputError(f"{where}: {name} cannot be made with these settings ({cause})"))


def _with_setting(message: str, cfg: DictConfig | None) -> str:
    """Return a message with the names of the settings that its subject refers to."""
    if cfg is None:
        return message
    names = _NAME.findall(message)[:_SUBJECT]
    plain = OmegaConf.to_container(cfg, resolve=False)
    found = list(dict.fromkeys(_referred(plain, [name.rstrip(".") for name in names])))
    if not found or any(re.search(rf"\b{re.escape(name)}\b", message) for name in found):
        return message
    return str(InputError(f"{message} (set by {' or '.join(found)})"))


def _referred(plain: Mapping[str, Any], names: list[str]) -> Iterator[str]:
    """Yield the settings that arguments of these names are given by."""
    for name in names:
        value = plain.get(name)
        # A part of a text too, as `test/${score}`.
        yield from REFERENCE.findall(value) if isinstance(value, str) else ()
    asked = {name.rpartition(".")[2] for name in names}
    for target in targets(plain, tuple(str(key) for key in plain)):
        for key in asked.intersection(target.keys):
            reference = REFERENCE.fullmatch(str(target.values[key]))
            if reference is not None and reference[1].rpartition(".")[2] != key:
                yield reference[1]


_FAULTS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "not permitted",
    errno.EIO: "the disk fails",
    errno.ENOTDIR: "a file is where a folder is needed",
    errno.EEXIST: "a file is where a folder is needed",
    errno.EISDIR: "a folder is where a file is needed",
    errno.EMFILE: "too many open files",
    errno.ENFILE: "too many open files",
    errno.ENAMETOOLONG: "the name is too long",
}
# Of PyTorch's allocators; that of a GPU is a RuntimeError too.
_MEMORY = re.compile("can't allocate memory|not enough memory|out of memory")
# So much of their reason is repeated.
_REASON = 200
_LOST_WORKER = re.compile(r"DataLoader worker \(pid\(?s?\)? ?[\d, ]+\)")


def machine_fault(error: BaseException) -> str | None:
    """Return one line about the fault of the machine that an error comes from; None: there is none.

    Args:
        error: with the errors that it was raised from, or while handling them.
    """
    for found in _chain(error):
        if isinstance(found, OSError) and found.errno in _FAULTS:
            place = found.filename2 or found.filename
            return one_line(f"{place}: {_FAULTS[found.errno]}" if place else _FAULTS[found.errno])
        if isinstance(found, MemoryError) or (
            isinstance(found, RuntimeError) and _MEMORY.search(str(found))
        ):
            reason = str(found).rpartition("DefaultCPUAllocator: ")[2]
            return one_line(f"there is not enough memory ({reason[:_REASON] or 'MemoryError'})")
        if isinstance(found, LostWorkerError) or (
            isinstance(found, RuntimeError) and _LOST_WORKER.search(str(found))
        ):
            return one_line(
                f"data.num_workers: a process that reads photographs has ended ({found}); where "
                "memory is short, fewer of them need less"
            )
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    seen: set[int] = set()
    found: BaseException | None = error
    while found is not None and id(found) not in seen:
        seen.add(id(found))
        yield found
        found = found.__cause__ or found.__context__


@contextmanager
def thread_faults_in_one_line() -> Iterator[None]:
    """Log one line where a full disk, or the like, ends a thread, such as TensorBoard's writer.

    Its owner hears of the error itself.  Other errors of threads keep their traceback.
    """
    before = threading.excepthook

    def told(arguments: threading.ExceptHookArgs) -> None:
        fault = machine_fault(arguments.exc_value) if arguments.exc_value else None
        if fault is None:
            before(arguments)
        else:
            name = arguments.thread.name if arguments.thread else "a thread"
            logger.warning("%s has ended: %s", name, fault)

    threading.excepthook = told
    try:
        yield
    finally:
        threading.excepthook = before
