"""A camera of one form is trained to the end of a rung, as a run of its own."""

import hashlib
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import lightning

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import table_name
from dolens.experiments.running.checkpoints import read_checkpoint
from dolens.experiments.running.command_line import override_text
from dolens.experiments.running.run_files import is_finished, metrics_of, read_json, write_json
from dolens.experiments.sweeps.job import clear, held, last_checkpoint
from dolens.experiments.tables import write_table

# The last words of a log that say why a run failed.
_REASON = 300


@dataclass(frozen=True)
class CameraTask:
    """A camera, and how far it is to be trained.

    Attributes:
        form: name of the form, which is that of its lens.
        seed: of the network, the crops and the noise.
        rung: number of the rung, from 1.
        epochs: in all, at the end of the rung.
        whole: epochs of the last rung, which learning rates follow.
        first: epochs of the first rung: as often it is validated.
        settings: what `dolens train` is given for every camera.
        score: that decides, as `psnr_db`.
        lens: text of the prescription.
        folder: the run folder.
        configuration: a folder whose `lens/` has the forms.
        working_folder: that the run starts in.
    """

    form: str
    seed: int
    rung: int
    epochs: int
    whole: int
    first: int
    settings: tuple[str, ...]
    score: str
    lens: str
    folder: Path
    configuration: Path
    working_folder: Path = field(default_factory=Path.cwd)

    @property
    def tested(self) -> bool:
        """Return whether this is the last rung, behind which there is a test."""
        return self.epochs == self.whole

    @property
    def record(self) -> Path:
        """Return the file that says that the rung is done."""
        return self.folder / f"rung_{self.rung}.json"

    def digest(self) -> str:
        """Return a digest of what decides the numbers of all rungs."""
        parts = [self.settings, self.score, self.lens, self.seed, self.whole, self.first]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def command(self) -> list[str]:
        """Return the command that trains it; it goes on from the last checkpoint, if any."""
        rung = "dolens.experiments.lens_search.trained_camera.EndOfRung"
        folder = override_text(str(self.folder))
        entry = f"{{_target_: {rung}, epochs: {self.epochs}, folder: {folder}}}"
        overrides = [
            *self.settings,
            f"hydra.searchpath=[{override_text(f'file://{self.configuration}')}]",
            f"lens={self.form}",
            f"seed={self.seed}",
            "threads=1",
            f"score={self.score}",
            f"trainer.max_epochs={self.whole}",
            f"trainer.check_val_every_n_epoch={self.first}",
            f"++callbacks.end_of_rung={entry}",
            f"hydra.run.dir={folder}",
        ]
        if not self.tested:
            overrides += ["test=false", f"objective=val/{self.score}", "++callbacks.pictures=null"]
        checkpoint = last_checkpoint(self.folder)
        if checkpoint is not None:
            overrides.append(f"ckpt_path={override_text(str(checkpoint))}")
        return [sys.executable, "-m", "dolens", "train", *overrides]


@dataclass(frozen=True)
class TrainedCamera:
    """Says what became of a camera at the end of a rung.

    Attributes:
        task: that was done.
        metrics: name → number of its run; empty where it failed.
        failed: why, in one line; empty where it did not.
    """

    task: CameraTask
    metrics: Mapping[str, float]
    failed: str = ""


def train_camera(task: CameraTask) -> TrainedCamera:
    """Train a camera to the end of a rung, or read what an earlier try has left.

    A run that fails is a result, so that others go on; a later try begins it again.

    Raises:
        InputError: the folder holds a camera of other settings.
    """
    task.folder.mkdir(parents=True, exist_ok=True)
    with held(task.folder):
        kept = read_json(task.record)
        other = read_json(_settings(task)).get("digest", task.digest())
        if other != task.digest():
            raise InputError(
                f"{task.folder}: holds a camera of other settings or another form; remove the "
                "folder, or choose another run folder"
            )
        if kept:
            return TrainedCamera(task, kept["metrics"])
        if not _ends_before(last_checkpoint(task.folder), task.epochs):
            clear(task.folder)
        write_json(_settings(task), {"digest": task.digest()})
        return _trained(task)


def _trained(task: CameraTask) -> TrainedCamera:
    command = task.command()
    (task.folder / "command.txt").write_text(shlex.join(command) + "\n", encoding="utf-8")
    with (task.folder / "output.txt").open("a", encoding="utf-8") as output:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=task.working_folder,
            check=False,
        )
    metrics = metrics_of(task.folder)
    if done.returncode != 0 or not is_finished(task.folder):
        return TrainedCamera(task, {}, _reason(task.folder / "output.txt", done.returncode))
    if f"val/{task.score}" not in metrics:
        return TrainedCamera(task, {}, f"its run has no val/{task.score}")
    write_json(task.record, {"epochs": task.epochs, "metrics": metrics})
    return TrainedCamera(task, metrics)


def _ends_before(checkpoint: Path | None, epochs: int) -> bool:
    """Return whether there is a checkpoint from which the rung's validation is still to come."""
    return checkpoint is not None and int(read_checkpoint(checkpoint)["epoch"]) + 1 < epochs


def _settings(task: CameraTask) -> Path:
    return task.folder / "camera.json"


def _reason(output: Path, status: int) -> str:
    lines = output.read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return (last or f"its process ended with status {status}")[-_REASON:]


def stage_of(epochs: int) -> str:
    """Return the stage whose table has the validation after so many epochs."""
    return f"val_{epochs}_epochs"


class EndOfRung(lightning.Callback):
    """Ends the training after some of its epochs; learning rates are those of the whole.

    The scores of the last validation are written by photograph, as those of a test are.

    Args:
        epochs: in all, counted from the training's own start.
        folder: the run folder.
    """

    def __init__(self, epochs: int, folder: str) -> None:
        self.epochs, self.folder = epochs, Path(folder)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Stop behind the last epoch of the rung."""
        if trainer.current_epoch + 1 >= self.epochs:
            trainer.should_stop = True

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the scores."""
        scores = getattr(pl_module, "validation_scores", None)
        if scores is not None:
            write_table(self.folder / table_name(stage_of(self.epochs)), scores.rows())
