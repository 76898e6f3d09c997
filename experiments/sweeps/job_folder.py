"""The folder of a sweep's job, as an earlier process may have left it."""

import fcntl
import logging
import math
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.experiments.running.plain_values import flat
from dolens.experiments.running.run_files import (
    CONFIG,
    INFO,
    METRICS,
    RESOLVED,
    metrics_of,
    read_yaml,
)
from dolens.prescriptions.plain_values import plain_values

logger = logging.getLogger(__name__)

_LAST = Path("checkpoints", "last.ckpt")
# How a run is made, not what comes of it.
_FREE = ("hydra", "threads")
# What a run writes before its first checkpoint; log.txt stays.
_LEFT = ("checkpoints", "tensorboard", "figures", "lens", INFO, METRICS, "metrics.csv")
# So many differences are named where a folder is refused.
_NAMED = 3


def refuse_other_settings(folder: Path, settings: str) -> None:
    """Refuse a folder that holds a run of other settings.

    Args:
        folder: of a job.
        settings: of the job that is to run there, as YAML, not resolved.

    Raises:
        InputError: a run has begun there with other settings; the message names the differences.
    """
    if not (folder / INFO).is_file():
        return  # no run got so far as to compute anything
    written = read_yaml(folder / CONFIG) or {}
    if written.get("ckpt_path") == str(folder / _LAST):
        written["ckpt_path"] = None  # the run was stopped before, and had gone on
    differences = _differences(_plain(written), _plain(plain_values(settings, "the job")))
    if differences:
        more = f" and {len(differences) - _NAMED} more" if len(differences) > _NAMED else ""
        raise InputError(
            f"hydra.sweep.dir: {folder} holds a run of other settings: "
            f"{'; '.join(differences[:_NAMED])}{more}; choose another folder, or remove this one"
        )


def recorded_objective(folder: Path) -> float | tuple[float, ...]:
    """Return the objective of a finished run, or several; NaN where its metrics do not have it."""
    named = (read_yaml(folder / RESOLVED) or {}).get("objective")
    metrics = metrics_of(folder)
    if isinstance(named, list):
        return tuple(metrics.get(str(name), math.nan) for name in named)
    return metrics.get(str(named), math.nan)


def last_checkpoint(folder: Path) -> Path | None:
    """Return the last checkpoint of a run that has not come to its end; None where it has none."""
    path = folder / _LAST
    if not (folder / INFO).is_file() or not path.is_file():
        return None
    if not zipfile.is_zipfile(path):
        logger.warning("%s is no whole checkpoint: the run begins anew", path)
        return None
    return path


def clear(folder: Path) -> None:
    """Remove what a run left that was stopped before its first checkpoint; its log stays."""
    for name in _LEFT:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def log_in(folder: Path, level: str, text: str) -> None:
    """Write a line into the log of a run whose own process does not write there, or not yet.

    Args:
        folder: of the run.
        level: `INFO`, `ERROR` and so on.
        text: of one line.
    """
    time = datetime.now().strftime("%Y-%m-%d %H:%M:%S,%f")[:-3]
    with (folder / "log.txt").open("a", encoding="utf-8") as file:
        file.write(f"[{time}] {level} {__name__}: {text}\n")


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Let no other process into a run folder; wait where another one is in it.

    A process that ends, however it ends, leaves the folder.  File systems that know no locks let
    everybody in.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            logger.warning("Another process runs this job in %s; waiting for its end", folder)
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError as error:
            logger.warning("%s cannot be locked (%s): start no second sweep there", folder, error)
        yield
    finally:
        os.close(handle)


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    return dict(flat({key: value for key, value in settings.items() if key not in _FREE}))


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [
        f"{name} is {now.get(name, 'not set')!r}, was {before.get(name, 'not set')!r}"
        for name in {**now, **before}
        if name not in now or name not in before or now[name] != before[name]
    ]
