"""Pictures of a lens before and after its design."""

import logging
from collections.abc import Callable
from pathlib import Path

import lightning
import torch
from matplotlib.figure import Figure

from dolens.errors import InputError
from dolens.imaging.field_curves import rms_against_field, rms_against_wavelength
from dolens.imaging.modulation import modulation
from dolens.imaging.ray_fans import ray_fans
from dolens.imaging.spots import spot_diagram, working_f_numbers
from dolens.optics.lens import Lens
from dolens.plotting import (
    before_after_figure,
    history_figure,
    modulation_figure,
    ray_fans_figure,
    rms_curves_figure,
    save_figure,
    spots_figure,
)
from experiments.callbacks.figures import log_figure
from experiments.design import DesignModule
from experiments.design_tables import spot_table

logger = logging.getLogger(__name__)

_FREQUENCIES = 51
# Beyond this over the RMS radius a spot's modulation is nearly nothing.
_BLURRED = 1.5


class DesignPictures(lightning.Callback):
    """Layout before and after, spots, ray fans, modulation, RMS curves, and the history.

    PNG files when the test ends, and the same in TensorBoard.

    Args:
        folder: where PNG files go; made when needed.
        most_frequency: cycles/mm, where the modulation's curves end; None: at half of what
            diffraction lets through, or where the final lens's spots leave nothing.
    """

    def __init__(self, folder: str, most_frequency: float | None = None) -> None:
        self.folder, self.most_frequency = Path(folder), most_frequency

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Draw, save and log them."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, draw in design_drawings(pl_module, self.most_frequency).items():
            try:
                figure = draw()
            except InputError as problem:
                # One analysis that this lens does not allow must not cost the others.
                logger.warning("No figure '%s': %s", name, problem)
                continue
            save_figure(figure, self.folder / f"{name}.png")
            log_figure(trainer, name, figure)


def design_drawings(
    module: DesignModule, most_frequency: float | None = None
) -> dict[str, Callable[[], Figure]]:
    """Name → what draws it."""
    lens, initial = module.lens, module.initial
    settings = module.evaluation
    fields = [tuple(field) for field in settings.fields_of(lens)]
    waves = list(settings.wavelengths_of(lens))
    distance = lens.object_distance

    def spots(of: Lens, title: str) -> Figure:
        return spots_figure(
            spot_diagram(of, fields, waves, object_distance=distance), title=f"Spots, {title}"
        )

    def layouts() -> Figure:
        # Drawn in the y-z plane: fields beside it would be drawn elsewhere than they are.
        angles = sorted({y for x, y in fields if x == 0.0}) if distance is None else []
        return before_after_figure(
            initial, lens, lens.primary_wavelength, angles or [0.0], object_distance=distance
        )

    def transfer(of: Lens, title: str) -> Figure:
        most = most_frequency
        if most is None:
            wave = torch.tensor([lens.primary_wavelength], dtype=torch.float64)
            number = float(working_f_numbers(lens, wave, distance)[0])
            most = 0.5 / (1e-6 * lens.primary_wavelength * number)
            blur = 1e-3 * spot_table(lens, module.evaluation).mean
            most = min(most, _BLURRED / max(blur, 1e-12))
        frequencies = torch.linspace(0.0, most, _FREQUENCIES, dtype=torch.float64)
        found = modulation(of, fields, waves, frequencies, object_distance=distance)
        return modulation_figure(found, title=f"Geometric MTF, {title}")

    def curves() -> Figure:
        return rms_curves_figure(
            rms_against_field(lens, waves, max(fields, key=_size), object_distance=distance)
            if any(_size(field) > 0.0 for field in fields)
            else None,
            rms_against_wavelength(lens, fields, _interval(waves), object_distance=distance),
        )

    drawings = {
        "layout": layouts,
        "spots": lambda: spots(lens, "final"),
        "spots_initial": lambda: spots(initial, "initial"),
        "ray_fans": lambda: ray_fans_figure(
            ray_fans(lens, fields, waves, object_distance=distance), title="Ray fans, final"
        ),
        "modulation": lambda: transfer(lens, "final"),
        "modulation_initial": lambda: transfer(initial, "initial"),
        "rms_curves": curves,
    }
    if module.history:
        history = module.history
        damping = [row.get("train/damping", float("nan")) for row in history]
        merits = [row["train/merit"] for row in history]
        drawings["history"] = lambda: history_figure(
            merits, damping if any(value == value for value in damping) else None
        )
    return drawings


def _size(field: tuple[float, float]) -> float:
    return field[0] ** 2 + field[1] ** 2


def _interval(wavelengths: list[float]) -> tuple[float, float]:
    """From the shortest to the longest; about a single one, 5 % both ways."""
    low, high = min(wavelengths), max(wavelengths)
    return (low, high) if high > low else (0.95 * low, 1.05 * low)
