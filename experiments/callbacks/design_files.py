"""Tables and files of a design besides its figures."""

import logging
from pathlib import Path

import lightning

from dolens.errors import InputError
from dolens.experiments.design.design import DesignModule
from dolens.experiments.design.iteration import operand_table
from dolens.experiments.tables import write_table
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription, prescription_of, save_lens

logger = logging.getLogger(__name__)

_ZEMAX_MODEL = "dfc"


class DesignFiles(lightning.Callback):
    """Writes the prescription for other programs, and tables of the search.

    - `lens/final.zmx`: its glasses are always those of the index model `dfc`.  A lens that was
      designed with another one is a little different there, and the log says so.
    - `history.csv`: a row of numbers for every iteration.
    - `operands.csv`: every operand's value at the end, and its derivative with respect to every
      variable.

    Args:
        folder: the run folder.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the files when training ends."""
        module: DesignModule = pl_module
        write_table(self.folder / "history.csv", module.history)
        if module.merit is not None:
            write_table(self.folder / "operands.csv", operand_table(module.merit))
        try:
            (self.folder / "lens").mkdir(parents=True, exist_ok=True)
            save_lens(_with_catalogue_lines(module.lens), self.folder / "lens" / "final.zmx")
        except InputError as problem:
            # Not every surface has a form there; the YAML file holds the lens whole.
            logger.warning("No .zmx file of this lens: %s", problem)


def _with_catalogue_lines(lens: Lens) -> Lens:
    """Return the lens with the indices that a .zmx file means by nd and Vd."""
    if lens.index_model == _ZEMAX_MODEL:
        return lens
    logger.warning(
        "lens/final.zmx: indices of model '%s' have no form there; its glasses are nd/Vd of model "
        "'%s', so that its spots differ from those reported",
        lens.index_model,
        _ZEMAX_MODEL,
    )
    prescription = {**prescription_of(lens), "index_model": _ZEMAX_MODEL}
    return lens_from_prescription(prescription, lens.dtype, where="lens/final.zmx")
