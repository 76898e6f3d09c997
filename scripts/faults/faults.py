"""What a run needs is taken away: one clear line, and the last good state intact.

Damaged checkpoints and kernels, numbers that are none, and loggers and figures that fail are in the
tests; here are faults that want a machine's own disks and processes, or root.
"""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from scripts.faults.kinds import CAMERA, COMMON, MANY_TASKS
from scripts.faults.processes import (
    PATIENCE_S,
    Process,
    await_checkpoint,
    goes_on,
    line_of,
    log,
    refused,
    start,
    trust,
    whole_run,
)
from scripts.faults.run_folders import differences, faults_of

Fault = Callable[[Path], list[str]]

RUN = [*CAMERA, *COMMON]
FIGURES = [entry for entry in RUN if entry != "callbacks.pictures=null"]
_TITLE = b"ray::_run"  # of a process that has a task
# Ray's workers end when they miss their run; its agents try for a minute to tell somebody first.
_ORPHANS_S = 90.0
_ABSENT = ["skipped: Ray is not installed"]
_SHARES = (0.0, 0.03, 0.08, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8, 0.95)


class Disk:
    """A small disk in memory; `mounted` is False where that is not allowed.

    Args:
        place: where it is mounted.
        size_kb: what it holds.
    """

    def __init__(self, place: Path, size_kb: int) -> None:
        self.place, self.size_kb, self.mounted = place, size_kb, False

    def __enter__(self) -> "Disk":
        self.place.mkdir(parents=True)
        options = f"size={self.size_kb}k"
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(self.place)]
        self.mounted = subprocess.run(command, capture_output=True).returncode == 0
        return self

    def __exit__(self, *_: object) -> None:
        if self.mounted:
            subprocess.run(["umount", "-l", str(self.place)], check=True)

    def set(self, options: str) -> None:
        """Mount it anew with other options, such as `ro` or another size."""
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.place)], check=True)


def full_disk(folder: Path, share: float) -> list[str]:
    """Run where there is room for a share of what a run writes, and then for all of it."""
    sample = whole_run(*FIGURES)
    needed = sum(-(-p.stat().st_size // 4096) * 4 for p in sample.rglob("*") if p.is_file())
    with Disk(folder / "disk", max(int(share * needed), 4)) as disk:
        if not disk.mounted:
            return ["skipped: mounting is not allowed here"]
        run = disk.place / "run"
        process = start([*FIGURES, f"hydra.run.dir={run}"], log(folder / "x"), trust)
        if process.wait(600.0):
            wrong = refused(process, "the disk is full")
        else:  # what it could do without found no room (TensorBoard's thread says so itself)
            wrong = [] if (run / "metrics.json").exists() else ["no metrics.json"]
        wrong += [f"left: {fault}" for fault in faults_of(run)] if run.exists() else []
        disk.set("size=1g")
        # It goes on on another disk, where its folder stays.
        moved = folder / "moved" / "run"
        if run.exists():
            shutil.copytree(run, moved)
        wrong += goes_on(moved, FIGURES)
    return wrong


def read_only_disk(folder: Path) -> list[str]:
    """Run where nothing can be written."""
    with Disk(folder / "disk", 64) as disk:
        if not disk.mounted:
            return ["skipped: mounting is not allowed here"]
        disk.set("ro")
        process = start([*RUN, f"hydra.run.dir={disk.place / 'run'}"], log(folder / "x"), trust)
        process.wait()
        return refused(process, "read-only")


def two_at_once(folder: Path) -> list[str]:
    """Start two runs in one second, in one folder."""
    folder.mkdir(parents=True, exist_ok=True)

    def prepare() -> None:
        trust()
        os.chdir(folder)

    both = [start([*RUN, f"seed={n}"], log(folder / "x"), prepare) for n in (0, 1)]
    if any([process.wait(600.0) for process in both]):
        return [line_of(process) for process in both]
    runs = list(folder.glob("outputs/*/*"))
    return [] if len(runs) == 2 else [f"{len(runs)} run folders for two runs"]


def lost_worker(folder: Path) -> list[str]:
    """Kill a process that reads photographs."""
    run = folder / "run"
    workers = [*RUN, "data.num_workers=1", "data.steps_per_epoch=40"]
    process = start([*workers, f"hydra.run.dir={run}"], log(run), trust)
    if not await_checkpoint(process, run):
        return [f"ends early: {line_of(process)}"]
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    if not children:
        return ["there is no worker"]
    os.kill(int(children[0]), signal.SIGKILL)
    process.wait()
    return refused(process, "data.num_workers") + faults_of(run) + goes_on(run, workers)


def unreadable_photograph(folder: Path) -> list[str]:
    """Cut the files of photographs short while a run reads them, and mend them for the next."""
    images, chance = folder / "images", np.random.default_rng(0)
    images.mkdir(parents=True)
    for number in range(8):
        pixels = chance.integers(0, 256, (96, 96, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / f"{number}.png")
    own = [entry for entry in RUN if not entry.startswith("data.steps")]
    own += ["data=image_folder", f"data.root={images}", "data.steps_per_epoch=10"]
    own += ["data.cache_bytes=0", "data.unreadable=error"]
    run = folder / "run"
    process = start([*own, f"hydra.run.dir={run}"], log(run), trust)
    if not await_checkpoint(process, run):
        return [f"ends early: {line_of(process)}"]
    whole = {path: path.read_bytes() for path in images.iterdir()}
    for path in whole:
        path.write_bytes(whole[path][:200])
    process.wait()
    wrong = refused(process, str(images), ".png", "data.unreadable=skip") + faults_of(run)
    for path in whole:
        path.write_bytes(whole[path])
    return wrong + goes_on(run, own)


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


FAULTS: dict[str, Fault] = {
    **{f"disk full at {s:.0%}": lambda f, s=s: full_disk(f, s) for s in _SHARES},
    "disk read-only": read_only_disk,
    "two runs in one second": two_at_once,
    "a worker is killed": lost_worker,
    "a photograph turns unreadable": unreadable_photograph,
    "a worker of Ray is killed": worker_killed,
    "a run with workers of Ray is killed": run_and_workers_killed,
}


def done(name: str, folder: Path) -> list[str]:
    """Do one fault, and return what fell."""
    shutil.rmtree(folder, ignore_errors=True)
    try:
        return FAULTS[name](folder)
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
