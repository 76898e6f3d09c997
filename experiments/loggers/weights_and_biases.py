"""Weights & Biases: files in the run folder, which only a user's own command uploads."""

from typing import Any

import numpy as np
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from dolens.experiments.loggers.failures import ends_alone
from dolens.experiments.loggers.protocol import RunSummary, require_package


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
