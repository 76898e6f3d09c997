"""The table of a test, photograph by photograph."""

from pathlib import Path

import lightning

from experiments.camera.photograph_scores import table_name
from experiments.tables import write_table


class PhotographTable(lightning.Callback):
    """`test_photographs.csv`: a row of scores for each test photograph and view.

    Every other judge has a table of its own, `test_wave_photographs.csv`.

    `scripts/compare.py` pairs runs by it.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write it."""
        for stage, scores in getattr(pl_module, "test_scores", {}).items():
            write_table(self.folder / table_name(stage), scores.rows())
