"""An experiment is a Lightning module with a lens: what a run asks of it.

An `Analysis` trains nothing, and iterates over `IterationData`.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import lightning
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.utils.data import DataLoader

from dolens.errors import InputError, check_count
from dolens.experiments.tables import Row, write_table
from dolens.optics.lens import Lens

# Precisions of a trainer: single, and the network's in half where Lightning's autocast reaches it.
EXACT, MIXED = "32-true", "bf16-mixed"

# Name → a function that draws the figure.  Nothing is drawn until somebody wants to keep it.
Figures = Mapping[str, Callable[[], Figure]]


class Experiment(lightning.LightningModule):
    """A lens and the work that is done with it.

    A subclass adds Lightning's own methods (`training_step`, `test_step`, ...) and overrides the
    methods below that it needs; each has a default.  A run uses them as follows:

    - `lens` is written to lens/initial.yaml before the work and to lens/final.yaml after it.
    - `summary()` adds numbers to metrics.json.
    - `metric_names()` says what will stand there, so that a wrong objective is met before the work.
    - `figures()` are drawn after the test, `training_figures()` during training.
    - `identity()` is stored in each checkpoint, and a checkpoint with another one is refused.
    - `checkpoint_state()` is stored in each checkpoint beside the weights.

    Args:
        lens: the lens; its parameters get `requires_grad=False`.

    Attributes:
        experiment: the name of the experiment, as in `experiment=<name>`; of a run.
        folder: the run folder, for tables; None outside a run, where none are written.
        trains: whether there is anything to train; False makes `train=true` an error.
        metrics: names of the metrics that a run can have beside its costs; see `metric_names`.
        precisions: of a trainer, that `check_trainer` lets pass.
    """

    trains: bool = True
    metrics: ClassVar[tuple[str, ...] | None] = None
    precisions: ClassVar[tuple[str, ...]] = (EXACT,)
    experiment: str = ""
    folder: Path | None = None

    def __init__(self, lens: Lens) -> None:
        super().__init__()
        self.lens = lens.requires_grad_(False)

    def place(self, experiment: str, folder: Path | None) -> None:
        """Say which run this is the work of; a run does so once the module is made.

        `__init__` does not know it: there `experiment` is empty and `folder` is None.

        Args:
            experiment: the name of the experiment.
            folder: the run folder.
        """
        self.experiment, self.folder = experiment, folder

    def summary(self) -> dict[str, float]:
        """Return numbers about the whole run for metrics.json; called once, when it is done."""
        return {}

    def metric_names(self) -> Collection[str] | None:
        """Return the names of all metrics that a run can have beside its costs, `cost/...`.

        `*` stands for anything in them.  None: they are not known before; an objective that is none
        of them is met at the first validation or at the end then.
        """
        return self.metrics

    def figures(self) -> Figures:
        """Return the figures of a finished test: name of the file without suffix → function."""
        return {}

    def training_figures(self) -> Figures:
        """Return the figures that are logged every few epochs, after validation."""
        return {}

    def lens_values(self) -> Mapping[str, Tensor]:
        """Return the parameters of the lens that move, by name, as the last step left them; they
        are recorded for `dolens watch`.
        """
        return {}

    def check_trainer(self, trainer: lightning.Trainer) -> None:
        """Refuse a trainer that would do this work otherwise than one process in `precisions`.

        An experiment that can share its batches among processes, accumulate gradients, or compute
        some of its work in half precision, overrides this.

        Raises:
            InputError: the line names the setting.
        """
        kind = type(self).__name__
        if trainer.world_size > 1:
            raise InputError(f"trainer.devices: {trainer.world_size}; allowed for {kind}: 1")
        if trainer.accumulate_grad_batches > 1:
            raise InputError(
                f"trainer.accumulate_grad_batches: {trainer.accumulate_grad_batches}; allowed for "
                f"{kind}: 1"
            )
        if trainer.precision not in self.precisions:
            allowed = ", ".join(self.precisions)
            raise InputError(
                f"trainer.precision: {trainer.precision}; allowed for {kind}: {allowed}"
            )

    # ---------------------------------------------------------------- checkpoints

    def identity(self) -> dict[str, Any]:
        """Return what a checkpoint must have in common with this module, as plain values."""
        return {"experiment": self.experiment, "lens": self.lens.name}

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what a checkpoint holds besides weights and optimizers.

        Returns:
            Plain values and tensors, under keys that Lightning does not use.
        """
        return {}

    def load_checkpoint_state(self, checkpoint: Mapping[str, Any]) -> None:
        """Take up what `checkpoint_state` has stored.

        Args:
            checkpoint: the whole checkpoint.
        """

    def settle(self) -> None:
        """Bring the lens to what a finished training leaves, with a checkpoint's state loaded.

        A search may leave its best round and not its last.
        """

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the identity and the state."""
        checkpoint["dolens"] = self.identity()
        checkpoint.update(self.checkpoint_state())

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another experiment before any weight is loaded.

        Raises:
            InputError: the identities differ.
        """
        refuse_another(checkpoint.get("dolens"), self.identity())
        self.load_checkpoint_state(checkpoint)


def check_experiment(module: Any, train: bool) -> None:
    """Check that a run can use a module.

    Args:
        module: the object that the configuration's `module` has made.
        train: whether the run is to train it.

    Raises:
        InputError: it is no `Experiment`, or it trains nothing and is to be trained.
    """
    kind = type(module).__name__
    if not isinstance(module, Experiment):
        raise InputError(
            f"module: {kind} is no experiment; derive it from "
            "dolens.experiments.experiment.Experiment, or from "
            "dolens.experiments.experiment.Analysis if it trains nothing"
        )
    if train and not module.trains:
        raise InputError(f"train: {kind} trains nothing; set train=false")


def refuse_another(found: Any, own: Mapping[str, Any]) -> None:
    """Refuse a checkpoint whose module says that it is another one.

    Args:
        found: what the checkpoint says of its module.
        own: what this run's module says of itself.

    Raises:
        InputError: they differ; the message names the first difference.
    """
    if not isinstance(found, Mapping):
        raise InputError("ckpt_path: this file is no checkpoint of a dolens experiment")
    for key, value in own.items():
        if found.get(key) != value:
            raise InputError(
                f"ckpt_path: the checkpoint's {key} is {found.get(key)!r}, this run's is "
                f"{value!r}; resume with the experiment and settings that wrote it"
            )


class Analysis(Experiment):
    """A lens and one computation on it, done in the test.

    A subclass overrides `analyse`, and `tables` and `figures` if it has any.  See `Experiment` for
    the arguments.

    Attributes:
        digits: significant digits of the numbers in tables.
    """

    trains: bool = False
    digits: ClassVar[int] = 6

    def analyse(self) -> Mapping[str, float]:
        """Do the work, and return its numbers by the names that they have in metrics.json.

        Gradients are enabled; a subclass that needs none decorates it with `torch.no_grad()`.
        """
        raise NotImplementedError(f"{type(self).__name__}.analyse")

    def tables(self) -> Mapping[str, Iterable[Row]]:
        """Return the tables: name of the file without suffix → rows; one without rows is left out.

        They are written when `analyse` is done.  A long analysis may call `write_tables` whenever a
        part of it is done; what was found is then kept if a later part fails.
        """
        return {}

    def write_tables(self) -> None:
        """Write `tables` as they are now to the run folder, as CSV files."""
        if self.folder is None:
            return
        for name, rows in self.tables().items():
            write_table(self.folder / f"{name}.csv", rows, self.digits)

    def summary(self) -> dict[str, float]:
        """Return the numbers that `analyse` returned; none before the test."""
        return dict(self._numbers or {})

    # ---------------------------------------------------------------- Lightning

    _numbers: Mapping[str, float] | None = None

    def configure_optimizers(self) -> None:
        """Return no optimizer."""

    def test_step(self, batch: Any, batch_idx: int) -> None:
        """Analyse, write the tables, and log the numbers."""
        # Lightning tests in inference mode, which derivatives do not work in.
        with torch.inference_mode(False), torch.enable_grad():
            self._numbers = self.analyse()
        self.write_tables()
        self.log_dict(self.summary(), batch_size=1)


class IterationData(lightning.LightningDataModule):
    """`IterationData` yields the numbers of the iterations of an epoch; for a test, one.

    Args:
        iterations: steps in an epoch.

    Raises:
        InputError: fewer than one.
    """

    def __init__(self, iterations: int = 1) -> None:
        super().__init__()
        check_count("data.iterations", iterations)
        self.iterations = iterations

    def train_dataloader(self) -> DataLoader:
        """Return 0, 1, 2, ..."""
        return DataLoader(range(self.iterations), batch_size=1)

    def test_dataloader(self) -> DataLoader:
        """Return one step."""
        return DataLoader(range(1), batch_size=1)
