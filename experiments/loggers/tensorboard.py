"""TensorBoard: curves, pictures, and a table of runs that has what was swept."""

from typing import Any

import numpy as np
import yaml
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from torch.utils.tensorboard.summary import hparams

from dolens.experiments.loggers.failures import ends_alone
from dolens.experiments.loggers.protocol import RunSummary


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
