"""What a design leaves as tables and files besides its pictures."""

import csv
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning

from dolens.errors import InputError
from dolens.prescriptions import save_lens
from experiments.design import DesignModule

logger = logging.getLogger(__name__)


class DesignFiles(lightning.Callback):
    """The prescription for other programs, and tables of the search.

    `lens/final.zmx`; `history.csv`: a row of numbers for every iteration; `operands.csv`: every
    operand's value at the end and its derivative by every variable.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write them."""
        module: DesignModule = pl_module
        write_table(self.folder / "history.csv", module.history)
        write_table(self.folder / "operands.csv", module.operand_table())
        try:
            (self.folder / "lens").mkdir(parents=True, exist_ok=True)
            save_lens(module.lens, self.folder / "lens" / "final.zmx")
        except InputError as problem:
            # Not every surface has a form there; the YAML file holds the lens whole.
            logger.warning("No .zmx file of this lens: %s", problem)


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV with all their keys for columns; nothing where there are no rows."""
    if not rows:
        return
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
