"""Runs the systems of the report, one after another, each in a process of its own."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dolens.experiments.report.code_version import code_fingerprint
from dolens.experiments.report.plan import System
from dolens.experiments.report.results import RECORD
from dolens.experiments.running.run_files import is_finished, read_json, write_json

# What a run may take to end by itself once it is interrupted.  Ctrl-C in a terminal reaches it too;
# a second signal at once would disturb what it saves.
_FIRST_GRACE_S, _GRACE_S = 3.0, 20.0
_POLL_S = 0.25


@dataclass(frozen=True)
class Finish:
    """How a run ended.

    Attributes:
        status: the exit status; 0 is success.
        wall_s: how long it took.
        cpu_s: processor time of all its threads.
        log: the file with what it printed.
    """

    status: int
    wall_s: float
    cpu_s: float
    log: Path


def system_command(system: System, folder: Path) -> list[str]:
    """Return the command that runs a system into a folder, from a checkout or a wheel alike."""
    if system.module is not None:
        return [sys.executable, "-m", system.module, str(folder)]
    train = [sys.executable, "-m", "dolens", "train"]
    return [*train, *system.overrides, f"hydra.run.dir={folder}"]


def shown_command(system: System) -> str:
    """Return the command that a reader types to repeat a system."""
    if system.module is not None:
        return f"python -m {system.module} FOLDER"
    return shlex.join(["dolens", "train", *system.overrides])


def is_current(system: System, folder: Path, any_code: bool = False) -> bool:
    """Return whether a folder holds this system, finished, with the same settings and code.

    Args:
        system: the system.
        folder: where its run is.
        any_code: take a run by another version of the code too.
    """
    record = read_json(folder / RECORD)
    if not is_finished(folder) or record.get("status") != 0:
        return False
    same = record.get("overrides") == list(system.overrides)
    return same and (any_code or record.get("code") == code_fingerprint())


def run_system(system: System, folder: Path, tick: Callable[[float], None]) -> Finish:
    """Run a system into a folder, which is emptied first if the report made it.

    What the run prints goes to `<folder>.log`.  When this process is interrupted, so is the run.

    Args:
        system: the system.
        folder: its run folder.
        tick: is called several times a second with the seconds since the start.

    Raises:
        FileExistsError: the folder exists and is none of the report's.
        KeyboardInterrupt: the user stopped it; the run has ended then.
    """
    _make_empty(folder)
    folder = folder.resolve()
    log = folder.with_name(f"{folder.name}.log")
    record = {
        "code": code_fingerprint(),
        "command": shown_command(system),
        "name": system.name,
        "overrides": list(system.overrides),
    }
    write_json(folder / RECORD, {**record, "status": None})
    started = time.perf_counter()
    with log.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(
            system_command(system, folder), stdout=output, stderr=subprocess.STDOUT
        )
        try:
            status, cpu = _wait(process, lambda: tick(time.perf_counter() - started))
        except KeyboardInterrupt:
            _stop(process)
            raise
    finish = Finish(status, time.perf_counter() - started, cpu, log)
    write_json(
        folder / RECORD,
        {**record, "status": finish.status, "wall_s": finish.wall_s, "cpu_s": finish.cpu_s},
    )
    return finish


def last_words(log: Path, lines: int = 3) -> str:
    """Return the last lines that a run printed."""
    text = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n".join([line for line in text if line.strip()][-lines:])


def _make_empty(folder: Path) -> None:
    if folder.exists():
        if not (folder / RECORD).is_file():
            raise FileExistsError(f"{folder} exists and was not made by dolens report")
        shutil.rmtree(folder)
    folder.mkdir(parents=True)


def _wait(process: subprocess.Popen, tick: Callable[[], None]) -> tuple[int, float]:
    """Return the exit status and the processor time in seconds."""
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, usage.ru_utime + usage.ru_stime
        tick()
        time.sleep(_POLL_S)


def _stop(process: subprocess.Popen) -> None:
    """Wait for an interrupted run, and end it if it does not end by itself."""
    try:
        process.wait(_FIRST_GRACE_S)
        return
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
