"""Where a lens focuses each wavelength."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from dolens.optics.lens import Lens
from experiments.analysis import Analysis
from experiments.experiment import Figures
from experiments.tables import Row


class ChromaticFocus(Analysis):
    """Finds the paraxial focus at several wavelengths.

    Args:
        lens: the lens.
        experiment: name of the experiment.
        folder: the run folder.
        wavelengths: nm.
    """

    def __init__(
        self, lens: Lens, experiment: str, folder: str | Path, wavelengths: Sequence[float]
    ) -> None:
        super().__init__(lens, experiment, folder)
        self.wavelengths = wavelengths
        self.rows: list[Row] = []

    def analyse(self) -> dict[str, float]:
        """Find the back focal distances, and return the range of them."""
        for wavelength in self.wavelengths:
            distance = float(self.lens.first_order(wavelength).bfd)
            self.rows.append({"wavelength_nm": wavelength, "bfd_mm": distance})
        distances = [float(row["bfd_mm"]) for row in self.rows]
        return {"chromatic_focus/range_mm": max(distances) - min(distances)}

    def tables(self) -> dict[str, list[Row]]:
        """Return `chromatic_focus`: a row for each wavelength."""
        return {"chromatic_focus": self.rows}

    def figures(self) -> Figures:
        """Return `chromatic_focus`."""
        return {"chromatic_focus": self._draw}

    def _draw(self) -> Figure:
        figure = Figure(figsize=(5.0, 3.5), layout="constrained")
        axes = figure.subplots()
        axes.plot(
            [row["wavelength_nm"] for row in self.rows],
            [row["bfd_mm"] for row in self.rows],
            marker="o",
        )
        axes.set(xlabel="wavelength, nm", ylabel="back focal distance, mm", title=self.lens.name)
        return figure
