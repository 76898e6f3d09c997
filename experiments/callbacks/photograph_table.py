"""Scores of test photographs as tables."""

from pathlib import Path

import lightning

from dolens.experiments.camera.photograph_scores import table_name
from dolens.experiments.tables import write_table


class PhotographTable(lightning.Callback):
    """Writes `test_photographs.csv`, a row of scores for each test photograph and view.

    Every judge has a table of its own besides, such as `test_wave_photographs.csv`.
    `dolens compare` pairs runs by these tables.  A camera that is judged as built has
    `made_lenses.csv`, a row for each lens, and `made_crops.csv`, one for each crop of each lens.

    Args:
        folder: the run folder.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the tables."""
        for stage, scores in getattr(pl_module, "test_scores", {}).items():
            write_table(self.folder / table_name(stage), scores.rows())
        made = getattr(pl_module, "made_scores", None)
        if made is not None:
            write_table(self.folder / "made_lenses.csv", made.rows(), digits=7)
            rows = [row for found in (made, *pl_module.made_front) for row in found.crop_rows()]
            write_table(self.folder / "made_crops.csv", rows, digits=7)
