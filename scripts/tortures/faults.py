"""What a run needs is taken away or damaged: one clear line, and the last good state intact."""

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from scripts.tortures.kinds import CAMERA, COMMON
from scripts.tortures.processes import Process, start, trust
from scripts.tortures.run_folders import differences, faults_of

RUN = [*CAMERA, *COMMON]
FIGURES = [entry for entry in RUN if entry != "callbacks.pictures=null"]
Fault = Callable[[Path], list[str]]


def line_of(process: Process) -> str:
    """Return the line by which a run ended."""
    lines = [line for line in process.said().splitlines() if line.strip()]
    return lines[-1] if lines else ""


def refused(process: Process, *words: str) -> list[str]:
    """Return what is wrong with the way in which a run failed."""
    said, line = process.said(), line_of(process)
    wrong = [] if process.status else ["the run did not fail"]
    if not line.startswith("error: "):
        wrong.append(f"ends in: {line[:200]}")
    if "Traceback" in said:
        wrong.append("prints a traceback")
    return wrong + [f"'{word}' is not in: {line[:300]}" for word in words if word not in line]


def goes_on(folder: Path, overrides: list[str], whole: list[str] | None = None) -> list[str]:
    """Resume a run, and return in what it differs from one that nothing happened to."""
    process = start([*whole_run(overrides), f"hydra.run.dir={folder.parent}/whole"], log(folder))
    if process.wait(600.0):
        return [f"the whole run fails: {line_of(process)}"]
    last = folder / "checkpoints" / "last.ckpt"
    resume = [f"ckpt_path={last}"] if last.exists() else []
    command = [*(whole or overrides), f"hydra.run.dir={folder}", *resume]
    process = start(command, log(folder), trust)
    if process.wait(600.0):
        return [f"the resumed run fails: {line_of(process)}"]
    return differences(folder.parent / "whole", folder)


def whole_run(overrides: list[str]) -> list[str]:
    """Return the overrides of a run without workers, whose samples are the same."""
    return [entry for entry in overrides if not entry.startswith("data.num_workers")]


def log(folder: Path) -> Path:
    """Return a new file for what a process prints."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder.parent / f"{len(list(folder.parent.glob('*.log')))}.log"


def await_checkpoint(process: Process, run: Path) -> bool:
    """Wait for the first checkpoint of a run; return whether there is one, and the run goes on."""
    last = run / "checkpoints" / "last.ckpt"
    while process.poll() is None and not last.exists():
        time.sleep(0.003)
    return process.poll() is None


# -------------------------------------------------------------------------------- the disk


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
    sample = folder / "sample"
    process = start([*FIGURES, f"hydra.run.dir={sample}"], log(sample))
    if process.wait(600.0):
        return [line_of(process)]
    needed = sum(-(-p.stat().st_size // 4096) * 4 for p in sample.rglob("*") if p.is_file())
    with Disk(folder / "disk", max(int(share * needed), 4)) as disk:
        if not disk.mounted:
            return ["skipped: mounting is not allowed here"]
        run = disk.place / "run"
        process = start([*FIGURES, f"hydra.run.dir={run}"], log(sample), trust)
        if process.wait(600.0):
            wrong = refused(process, "the disk is full")
        else:  # what it could do without found no room
            wrong = [] if (run / "metrics.json").exists() else ["no metrics.json"]
            wrong += ["prints a traceback"] if "Traceback" in process.said() else []
        wrong += [f"left: {fault}" for fault in faults_of(run)] if run.exists() else []
        disk.set("size=1g")
        shutil.rmtree(sample)
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
    import shlex

    words = shlex.split(said[0].split("Resume with: dolens train ")[1])
    process = start(words, log(folder / "x"), trust)
    return [line_of(process)] if process.wait() else faults_of(run)


# -------------------------------------------------------------------------------- checkpoints


def damaged_checkpoint(folder: Path, damage: Callable[[bytes], bytes], said: str) -> list[str]:
    """Resume from a checkpoint that something has happened to."""
    run = folder / "run"
    process = start([*RUN, "trainer.max_epochs=1", f"hydra.run.dir={run}"], log(run), trust)
    if process.wait(600.0):
        return [line_of(process)]
    last = run / "checkpoints" / "last.ckpt"
    last.write_bytes(damage(last.read_bytes()))
    kept = last.read_bytes()
    process = start(
        [*RUN, f"hydra.run.dir={folder / 'again'}", f"ckpt_path={last}"], log(run), trust
    )
    process.wait()
    wrong = refused(process, "last.ckpt", said)
    return wrong if last.read_bytes() == kept else [*wrong, "the file is another one"]


def flipped(content: bytes) -> bytes:
    """Flip a bit of a weight."""
    place = len(content) // 3
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


def cut(content: bytes) -> bytes:
    """Take away the end."""
    return content[: int(0.7 * len(content))]


class Code:
    """Runs code where it is unpickled without care."""

    def __reduce__(self) -> tuple:
        return os.system, ("touch /tmp/dolens_torture_was_executed",)


def with_code(content: bytes) -> bytes:
    """Replace a checkpoint by one that runs code."""
    import io

    buffer = io.BytesIO()
    torch.save({"state_dict": {}, "dolens": Code()}, buffer)
    return buffer.getvalue()


# -------------------------------------------------------------------------------- the training


def nan_in_loss(folder: Path) -> list[str]:
    """Let the third step's loss be no number."""

    def prepare() -> None:
        trust()
        from dolens.experiments.camera.base import Camera

        real = Camera.loss_over_views

        def broken(self: Camera, restored: torch.Tensor, truth: torch.Tensor) -> dict:
            terms = real(self, restored, truth)
            if self.trainer.training and self.global_step == 2:
                terms["total"] = terms["total"] * float("nan")
            return terms

        Camera.loss_over_views = broken

    run = folder / "run"
    process = start([*RUN, f"hydra.run.dir={run}"], log(run), prepare)
    process.wait()
    wrong = refused(process, "step 3", "photographs", "train/loss nan")
    return wrong + faults_of(run) + goes_on(run, RUN)


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
    """Cut a photograph's file short while a run reads it."""
    images, chance = folder / "images", np.random.default_rng(0)
    images.mkdir(parents=True)
    for number in range(8):
        pixels = chance.integers(0, 256, (96, 96, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / f"{number}.png")
    own = [entry for entry in RUN if not entry.startswith("data.steps")]
    own += ["data=image_folder", f"data.root={images}", "data.steps_per_epoch=30"]
    run = folder / "run"
    process = start([*own, "+data.cache_bytes=0", f"hydra.run.dir={run}"], log(run), trust)
    if not await_checkpoint(process, run):
        return [f"ends early: {line_of(process)}"]
    for path in images.iterdir():
        path.write_bytes(path.read_bytes()[:200])
    process.wait()
    return refused(process, ".png") + faults_of(run)


def failing_figure(folder: Path) -> list[str]:
    """Let the figures fail: the numbers are not lost with them."""

    def prepare() -> None:
        trust()
        from dolens.experiments.callbacks import figures

        def fail(*_: object, **__: object) -> None:
            raise RuntimeError("no ink")

        figures.save_figures = fail

    run = folder / "run"
    process = start([*FIGURES, f"hydra.run.dir={run}"], log(run), prepare)
    status = process.wait(600.0)
    wrong = [] if (run / "metrics.json").exists() and status == 0 else [line_of(process)]
    return wrong if "no ink" in process.said() else [*wrong, "does not say it"]


def failing_tensorboard(folder: Path) -> list[str]:
    """Let TensorBoard fail at its second call."""

    def prepare() -> None:
        trust()
        from torch.utils.tensorboard import SummaryWriter

        def fail(*_: object, **__: object) -> None:
            raise OSError("the board is broken")

        SummaryWriter.add_scalar = fail

    run = folder / "run"
    process = start([*RUN, f"hydra.run.dir={run}"], log(run), prepare)
    status = process.wait(600.0)
    wrong = [] if (run / "metrics.json").exists() and status == 0 else [line_of(process)]
    if process.said().count("the run goes on without it") != 1:
        wrong.append("does not say it, or more than once")
    return wrong


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


_SHARES = (0.0, 0.03, 0.08, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8, 0.95)
FAULTS: dict[str, Fault] = {
    **{f"disk full at {s:.0%}": lambda f, s=s: full_disk(f, s) for s in _SHARES},
    "disk read-only": read_only_disk,
    "run folder is a file": lambda f: file_for_folder(f, ""),
    **{
        f"{name} is a file": lambda f, name=name: file_for_folder(f, name)
        for name in ("checkpoints", "lens", ".hydra", "tensorboard", "figures")
    },
    "a folder with odd names": odd_names,
    "two runs in one second": two_at_once,
    "checkpoint: one bit": lambda f: damaged_checkpoint(f, flipped, "checksum"),
    "checkpoint: cut": lambda f: damaged_checkpoint(f, cut, "not a safe checkpoint"),
    "checkpoint: empty": lambda f: damaged_checkpoint(f, lambda _: b"", "not a safe checkpoint"),
    "checkpoint: code": lambda f: damaged_checkpoint(f, with_code, "not a safe checkpoint"),
    "NaN in a loss": nan_in_loss,
    "a worker is killed": lost_worker,
    "a photograph turns unreadable": unreadable_photograph,
    "figures fail": failing_figure,
    "TensorBoard fails": failing_tensorboard,
}


def done(name: str, folder: Path) -> list[str]:
    """Do one fault, and return what fell."""
    random.seed(0)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        return FAULTS[name](folder)
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
