"""Processes of Ray that do the tasks of a run are killed, one of them or with the run itself."""

import os
import signal
import time
from importlib.util import find_spec
from pathlib import Path

from scripts.tortures.ends import line_of, log, whole_run
from scripts.tortures.kinds import COMMON, MANY_TASKS
from scripts.tortures.processes import PATIENCE_S, Process, start, trust
from scripts.tortures.run_folders import differences, faults_of

_TITLE = b"ray::_run"  # of a process that has a task
# Ray's workers end when they miss their run; its agents try for a minute to tell somebody first.
_ORPHANS_S = 90.0
_ABSENT = ["skipped: Ray is not installed"]


def worker_killed(folder: Path) -> list[str]:
    """Kill a process of Ray in the middle of its tasks: others do them, to the same bits."""
    if find_spec("ray") is None:
        return _ABSENT
    run = folder / "run"
    process = _started(run)
    victim = _at_work(process)
    if victim is None:
        return [f"no process of Ray has a task: {line_of(process)}"]
    os.kill(victim, signal.SIGKILL)
    if process.wait(600.0):
        return [f"the run fails: {line_of(process)}"]
    return faults_of(run) + differences(whole_run(*MANY_TASKS, *COMMON, "workers=0"), run)


def run_and_workers_killed(folder: Path) -> list[str]:
    """Kill a run with workers: its workers end too, and the run can be made once more."""
    if find_spec("ray") is None:
        return _ABSENT
    run = folder / "run"
    process = _started(run)
    if _at_work(process) is None:
        return [f"no process of Ray has a task: {line_of(process)}"]
    family = _descendants(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    end = time.monotonic() + _ORPHANS_S
    while (left := [pid for pid in family if _command(pid)]) and time.monotonic() < end:
        time.sleep(0.1)
    wrong = [f"goes on: {_command(pid).decode()[:150]}" for pid in left] + faults_of(run)
    process = _started(run)
    if process.wait(600.0):
        return [*wrong, f"the run that begins anew fails: {line_of(process)}"]
    return wrong + differences(whole_run(*MANY_TASKS, *COMMON, "workers=0"), run)


def _started(run: Path) -> Process:
    return start([*MANY_TASKS, *COMMON, "workers=2", f"hydra.run.dir={run}"], log(run), trust)


def _at_work(process: Process) -> int | None:
    """Wait until a process of Ray has a task, and return its number; None if there is none."""
    end = time.monotonic() + PATIENCE_S
    while process.poll() is None and time.monotonic() < end:
        for pid in _descendants(process.pid):
            if _command(pid).startswith(_TITLE):
                return pid
        time.sleep(0.01)
    return None


def _descendants(pid: int) -> list[int]:
    """Return the numbers of a process's children, of theirs, and so on."""
    found, parents = [], {pid}
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            children.setdefault(int(fields[1]), []).append(int(entry.name))
    while parents:
        parents = {child for parent in parents for child in children.get(parent, [])}
        found += sorted(parents)
    return found


def _command(pid: int) -> bytes:
    """Return the command line of a process; nothing where it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ")
    except OSError:
        return b""
