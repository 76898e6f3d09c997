"""What happens to a training: numbers that are none, lost processes, photographs and loggers."""

import os
import signal
from pathlib import Path

import numpy as np
from PIL import Image

from scripts.tortures.disks import FIGURES, RUN
from scripts.tortures.ends import await_checkpoint, goes_on, line_of, log, refused
from scripts.tortures.processes import start, trust
from scripts.tortures.run_folders import faults_of


def nan_in_loss(folder: Path) -> list[str]:
    """Let the third step's loss be no number."""

    def prepare() -> None:
        trust()
        from dolens.experiments.camera.base import Camera

        real = Camera.loss_over_views

        def broken(self: Camera, *arguments: object, **options: object) -> dict:
            terms = real(self, *arguments, **options)
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


def failing_figure(folder: Path) -> list[str]:
    """Let the figures fail: the numbers are not lost with them."""

    def prepare() -> None:
        trust()
        from dolens.experiments.callbacks import saved_figures

        def fail(*_: object, **__: object) -> None:
            raise RuntimeError("no ink")

        saved_figures.save_figures = fail

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
