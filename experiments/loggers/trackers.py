"""Experiment trackers: TensorBoard, MLflow, and Weights & Biases."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from torch.utils.tensorboard.summary import hparams

from dolens.experiments.loggers.protocol import RunSummary, ends_alone, require_package


@ends_alone
class TensorBoard(TensorBoardLogger):
    """Writes event files for TensorBoard, into one folder: each is a run of its own to TensorBoard.

    Args:
        save_dir: the folder of the event files.
        options: of Lightning's `TensorBoardLogger`.
    """

    def __init__(self, save_dir: str, **options: Any) -> None:
        given = {"name": "", "version": "", "default_hp_metric": False, **options}
        super().__init__(save_dir, **given)

    @rank_zero_only
    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Add a picture (height, width, 3), uint8."""
        self.experiment.add_image(name, picture, global_step=step, dataformats="HWC")

    @rank_zero_only
    def log_summary(self, summary: RunSummary) -> None:
        """Add all numbers at the last step, the settings as text, and the run's row of the table.

        `add_hparams` would write the columns of this run as those of all runs: where TensorBoard
        finds such a list, it takes the first run's, and leaves out what other runs have besides.
        Without one it gathers the columns from all runs.
        """
        self.log_metrics(dict(summary.numbers), step=summary.step)
        settings = yaml.safe_dump(dict(summary.settings), sort_keys=False, allow_unicode=True)
        self.experiment.add_text("settings", f"```yaml\n{settings}```", summary.step)
        if summary.objective in summary.numbers:
            # TensorBoard sorts the columns by name: a capital letter comes before the others.
            objective = summary.numbers[summary.objective]
            self.experiment.add_scalar("Objective", objective, summary.step)
        _, start, end = hparams(dict(summary.choices), {})
        for part in (start, end):
            self.experiment.file_writer.add_summary(part)
        self.experiment.flush()


# MLflow refuses longer values.
_LONGEST = 500


@ends_alone
class MLflow(MLFlowLogger):
    """Writes to MLflow.  Nothing leaves this machine, whatever MLFLOW_TRACKING_URI says.

    Args:
        experiment_name: MLflow's name of a group of runs.
        run_name: name of this run.
        folder: of the local store: mlflow.db and artifacts.
        tracking_uri: of another store, such as a server's address; None: the local one.
        options: of Lightning's `MLFlowLogger`.

    Raises:
        InputError: MLflow is not installed.
    """

    def __init__(
        self,
        experiment_name: str,
        run_name: str,
        folder: str,
        tracking_uri: str | None = None,
        **options: Any,
    ) -> None:
        require_package("mlflow", "mlflow")
        if tracking_uri is None:
            store = Path(folder).resolve()
            store.mkdir(parents=True, exist_ok=True)
            tracking_uri = f"sqlite:///{store / 'mlflow.db'}"
            options.setdefault("artifact_location", (store / "artifacts").as_uri())
        super().__init__(experiment_name, run_name, tracking_uri, **options)

    @rank_zero_only
    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Log a picture (height, width, 3), uint8, at a step."""
        self.experiment.log_image(self.run_id, picture, key=name, step=step)

    @rank_zero_only
    def log_summary(self, summary: RunSummary) -> None:
        """Log all settings as parameters, the few that matter as tags, and the numbers."""
        self.log_hyperparams({n: str(v)[:_LONGEST] for n, v in summary.settings.items()})
        for name, value in summary.choices.items():
            self.experiment.set_tag(self.run_id, name, str(value))
        self.log_metrics(
            {**summary.numbers, **summary.headline_numbers()},
            step=summary.step,
        )


@ends_alone
class WeightsAndBiases(WandbLogger):
    """Writes to Weights & Biases, offline unless the configuration says otherwise.

    Args:
        project: its name for a group of runs.
        name: of this run.
        save_dir: folder of its files, of which `wandb sync` uploads what is in them.
        offline: False uploads everything at once.
        options: of Lightning's `WandbLogger`.

    Raises:
        InputError: wandb is not installed.
    """

    def __init__(
        self, project: str, name: str, save_dir: str, offline: bool = True, **options: Any
    ) -> None:
        require_package("wandb", "wandb")
        super().__init__(name=name, save_dir=save_dir, offline=offline, project=project, **options)

    @rank_zero_only
    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Log a picture (height, width, 3), uint8, at a step."""
        self.log_image(name, [picture], step, caption=[caption])

    @rank_zero_only
    def log_summary(self, summary: RunSummary) -> None:
        """Log all settings as the run's config, and its numbers as its summary."""
        self.log_hyperparams(dict(summary.settings))
        self.log_metrics(dict(summary.numbers), step=summary.step)
        self.experiment.summary.update({**summary.numbers, **summary.headline_numbers()})
