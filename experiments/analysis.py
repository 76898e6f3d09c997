"""The contract of experiments that analyse a lens and train nothing."""

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import torch

from dolens.experiments.experiment import Experiment
from dolens.experiments.tables import Row, write_table


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
