"""Disks that are full or read-only, and files where folders should be."""

import os
import shlex
import shutil
import signal
import subprocess
from pathlib import Path

from scripts.tortures.ends import await_checkpoint, goes_on, line_of, log, refused, whole_run
from scripts.tortures.kinds import CAMERA, COMMON
from scripts.tortures.processes import start, trust
from scripts.tortures.run_folders import faults_of

RUN = [*CAMERA, *COMMON]
FIGURES = [entry for entry in RUN if entry != "callbacks.pictures=null"]


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
        wrong += goes_on_there(folder, run)
    return wrong


def goes_on_there(folder: Path, run: Path) -> list[str]:
    """Resume a run on another disk, where its folder stays."""
    (folder / "moved").mkdir(parents=True)
    moved = folder / "moved" / "run"
    if run.exists():
        shutil.copytree(run, moved)
    return goes_on(moved, FIGURES)


def read_only_disk(folder: Path) -> list[str]:
    """Run where nothing can be written."""
    with Disk(folder / "disk", 64) as disk:
        if not disk.mounted:
            return ["skipped: mounting is not allowed here"]
        disk.set("ro")
        process = start([*RUN, f"hydra.run.dir={disk.place / 'run'}"], log(folder / "x"), trust)
        process.wait()
        return refused(process, "read-only")


def file_for_folder(folder: Path, below: str) -> list[str]:
    """Run where a file is in the place of a folder."""
    run = folder / "run"
    path = run / below if below else run
    path.parent.mkdir(parents=True)
    path.write_text("a file\n")
    process = start([*FIGURES, f"hydra.run.dir={run}"], log(run), trust)
    process.wait()
    wrong = refused(process, "folder", str(path)) if below not in ("tensorboard", "figures") else []
    if path.read_text() != "a file\n":
        wrong.append("the file is another one")
    return wrong


def odd_names(folder: Path) -> list[str]:
    """Stop a run in a folder with blanks, commas and quotes, and go on as it says."""
    run = folder / "a b, c=1's" / "run"
    quoted = str(run).replace("'", "\\'")
    process = start([*RUN, f"hydra.run.dir='{quoted}'"], log(folder / "x"), trust)
    if not await_checkpoint(process, run):
        return [f"ends early: {line_of(process)}"]
    os.kill(process.pid, signal.SIGINT)
    process.wait()
    said = [line for line in process.said().splitlines() if "Resume with:" in line]
    if not said:
        return ["does not say how to resume"]
    words = shlex.split(said[0].split("Resume with: dolens train ")[1])
    process = start(words, log(folder / "x"), trust)
    return [line_of(process)] if process.wait() else faults_of(run)
