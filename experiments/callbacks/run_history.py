"""A callback records the course of a run, for the page of `dolens watch`."""

import math
import time
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor

from dolens.errors import InputError, check_count
from dolens.experiments.callbacks.photograph_results import ChosenCrops
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.camera_figures import view_name
from dolens.experiments.experiment import Experiment
from dolens.experiments.watch.history import FOLDER, Frame, Recorder
from dolens.optimize import DesignVariables
from dolens.photograph_page.page import picture_bytes

_PHOTOGRAPHS = 2


class RecordHistory(ChosenCrops):
    """Records the lens of a run as it moves, and what a camera sees and restores of photographs.

    A frame of the lens is recorded after a step, of photographs after a validation, each so rarely
    that it takes half a percent of the run's time at most.  A run that is resumed goes on with the
    history of the run whose checkpoint it has.

    Args:
        folder: the run folder; the history is in `history` there.
        frames: that are kept at most, spread over the run.
        megabytes: of photographs, likewise.

    Raises:
        InputError: a number out of range.
    """

    def __init__(self, folder: str, frames: int = 300, megabytes: float = 4.0) -> None:
        check_count("callbacks.history: frames", frames, 16)
        if not 0.0 < megabytes <= 1000.0:
            raise InputError(f"callbacks.history: megabytes {megabytes}; allowed: above 0, to 1000")
        super().__init__(_PHOTOGRAPHS)
        self.run = Path(folder)
        self._settings = frames, int(megabytes * 2**20)
        self._recorder: Recorder | None = None
        self._pictures: dict[str, dict[str, bytes]] = {}
        self._seconds = 0.0  # that they took

    def on_train_epoch_start(self, trainer: lightning.Trainer, pl_module: Experiment) -> None:
        """Keep where a round of a design begins: its rays are chosen there."""
        recorder = self._begun(trainer, pl_module)
        if recorder is not None and not isinstance(pl_module, Camera):
            frame = _frame(pl_module)
            frame.step = trainer.global_step
            recorder.history.rounds.append(frame)

    def on_train_batch_start(
        self, trainer: lightning.Trainer, pl_module: Experiment, *arguments: Any
    ) -> None:
        """Begin, where a run is resumed within an epoch, whose start does not come again."""
        self._begun(trainer, pl_module)

    def _begun(self, trainer: lightning.Trainer, module: Experiment) -> Recorder | None:
        """Return the recorder; make it first, with the history of the run that this one resumes."""
        if self._recorder is not None or not trainer.is_global_zero:
            return self._recorder
        if not isinstance(module, Camera) and not module.lens_values():
            return None
        self._recorder = recorder = Recorder(self.run, *self._settings)
        step = trainer.global_step
        if step and trainer.ckpt_path is not None:
            of = Path(str(trainer.ckpt_path)).resolve().parents
            # A run has its checkpoints in a folder of their own.
            before = next((f for f in (self.run, *of[:2]) if (f / FOLDER).is_dir()), self.run)
            recorder.go_on(before, step)
        variables = getattr(module, "variables", None)
        if isinstance(variables, DesignVariables):
            recorder.history.bounds = _bounds(variables)
        recorder.add(step, _frame(module), time.monotonic())
        return recorder

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: Experiment, *arguments: Any
    ) -> None:
        """Record the lens, if it is time."""
        if self._recorder is not None and self._recorder.due():
            started = time.monotonic()
            self._recorder.add(trainer.global_step, _frame(pl_module), started)

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: Experiment) -> None:
        """Choose the photographs, if it is time."""
        self._crops, self._pictures = {}, {}
        find = getattr(trainer.datamodule, "evaluation_photographs", None)
        recorder = self._recorder
        if recorder is None or find is None or trainer.sanity_checking:
            return
        last = trainer.current_epoch + 1 == trainer.max_epochs
        if last or recorder.due("pictures"):
            self._choose(find("validation"))

    def on_validation_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: Experiment,
        outputs: object,
        batch: Tensor,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the images of the chosen crops in this batch."""
        if not self._crops or not isinstance(pl_module, Camera):
            return
        started = time.monotonic()
        labels = ("truth", "sensor", "restored")
        for _, photograph, view, images in self.seen(trainer, pl_module, "val", batch, batch_idx):
            self._pictures[f"{photograph}, {view_name(view)}"] = {
                label: picture_bytes(image, lossless=False)
                for label, image in zip(labels, images, strict=True)
            }
        self._seconds += time.monotonic() - started

    def on_validation_epoch_end(self, trainer: lightning.Trainer, pl_module: Experiment) -> None:
        """Record the photographs, with the point spread functions of that moment."""
        if self._recorder is None or not self._pictures:
            return
        started = time.monotonic() - self._seconds
        pictures = {**self._pictures, "PSF": {"PSF": _functions_picture(pl_module)}}
        self._recorder.add(trainer.global_step, _frame(pl_module), started, pictures)
        self._pictures, self._seconds = {}, 0.0

    def on_train_end(self, trainer: lightning.Trainer, pl_module: Experiment) -> None:
        """Record the last step, and write."""
        if self._recorder is not None:
            self._recorder.add(trainer.global_step, _frame(pl_module), time.monotonic())
            self._recorder.write()

    def on_exception(self, *arguments: Any) -> None:
        """Write what was recorded."""
        if self._recorder is not None:
            self._recorder.write()


@torch.no_grad()
def _frame(module: Experiment) -> Frame:
    """Return the lens as it is now."""
    return Frame(0, 0.0, {n: v.detach().tolist() for n, v in module.lens_values().items()})


def _bounds(variables: DesignVariables) -> dict[str, list[Any]]:
    scale = variables.file_scale
    ends = ((scale * end).tolist() for end in (variables.lower, variables.upper))
    limits = [[x if math.isfinite(x) else None for x in end] for end in ends]
    rows = zip(variables.labels(), *limits, variables.unit_names, strict=True)
    return {label: [low, high, unit] for label, low, high, unit in rows}


@torch.no_grad()
def _functions_picture(camera: Any) -> bytes:
    """Return the point spread functions of all views side by side, each up to its own peak."""
    lens = camera.lens.with_values(camera.variables())
    found = camera.views.point_spread_functions(lens)
    found = found.reshape(-1, *found.shape[-3:]).float().cpu()
    found = (found / found.amax((1, 2, 3), keepdim=True).clamp(min=1e-30)).sqrt()
    return picture_bytes(torch.cat([*torch.nn.functional.pad(found, (1, 1, 1, 1), value=1.0)], -1))
