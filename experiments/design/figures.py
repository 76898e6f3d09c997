"""Figures of a lens before and after its design."""

from collections.abc import Callable, Mapping, Sequence

import torch
from matplotlib.figure import Figure

from dolens.analysis.modulation_transfer import modulation
from dolens.analysis.ray_fans import ray_fans
from dolens.analysis.rms_curves import rms_against_field, rms_against_wavelength
from dolens.analysis.spot_diagram import spot_diagram, working_f_numbers
from dolens.experiments.design.tables import SQUARE_GRID_COUNT, spot_table
from dolens.experiments.experiment import Figures
from dolens.optics.lens import Lens
from dolens.optimize import MeritSettings
from dolens.plotting import (
    before_after_figure,
    history_figure,
    modulation_figure,
    ray_fans_figure,
    rms_curves_figure,
    spots_figure,
)

_FREQUENCIES = 51
# Beyond this over the RMS radius a spot's modulation is nearly nothing.
_BLURRED = 1.5


def design_figures(
    lens: Lens,
    initial: Lens,
    settings: MeritSettings,
    history: Sequence[Mapping[str, float]],
    max_frequency: float | None = None,
) -> Figures:
    """Return the layout, spots, ray fans, MTF and RMS curves of a design, and its history.

    Args:
        lens: the design.
        initial: the lens where the search began.
        settings: fields and wavelengths, and the rays of `rms_spot_um`.
        history: a row of numbers for every iteration; empty if nothing was trained.
        max_frequency: the end of the MTF curves, cycles/mm; None: half of the diffraction limit, or
            less, where the spots of the design leave no contrast.
    """
    fields = [tuple(field) for field in settings.fields_of(lens)]
    waves = list(settings.wavelengths_of(lens))
    distance = lens.object_distance

    pupil = pupil_note(settings)

    def spots(of: Lens, title: str) -> Figure:
        found = spot_diagram(of, fields, waves, object_distance=distance)
        rays = int((found.weight > 0.0).sum())
        return spots_figure(found, title=f"Spots, {title}: {rays} rays over the whole stop{pupil}")

    def layouts() -> Figure:
        # Drawn in the y-z plane: fields beside it would be drawn elsewhere than they are.
        angles = sorted({y for x, y in fields if x == 0.0}) if distance is None else []
        return before_after_figure(
            initial, lens, lens.primary_wavelength, angles or [0.0], object_distance=distance
        )

    def transfer(of: Lens, title: str) -> Figure:
        most = max_frequency
        if most is None:
            wave = torch.tensor([lens.primary_wavelength], dtype=torch.float64)
            number = float(working_f_numbers(lens, wave, distance)[0])
            most = 0.5 / (1e-6 * lens.primary_wavelength * number)
            blur = 1e-3 * spot_table(lens, settings).mean
            most = min(most, _BLURRED / max(blur, 1e-12))
        frequencies = torch.linspace(0.0, most, _FREQUENCIES, dtype=torch.float64)
        found = modulation(of, fields, waves, frequencies, object_distance=distance)
        return modulation_figure(found, title=f"Geometric MTF, {title}, of the whole stop{pupil}")

    def curves() -> Figure:
        return rms_curves_figure(
            rms_against_field(lens, waves, max(fields, key=_size), object_distance=distance)
            if any(_size(field) > 0.0 for field in fields)
            else None,
            rms_against_wavelength(lens, fields, _interval(waves), object_distance=distance),
            title=f"RMS spot radius, rays over the whole stop{pupil}",
        )

    figures: dict[str, Callable[[], Figure]] = {
        "layout": layouts,
        "spots": lambda: spots(lens, "final"),
        "spots_initial": lambda: spots(initial, "initial"),
        "ray_fans": lambda: ray_fans_figure(
            ray_fans(lens, fields, waves, object_distance=distance),
            title=f"Ray fans, final, across the whole stop{pupil}",
        ),
        "modulation": lambda: transfer(lens, "final"),
        "modulation_initial": lambda: transfer(initial, "initial"),
        "rms_curves": curves,
    }
    if history:
        damping = [row.get("train/damping", float("nan")) for row in history]
        merits = [row["train/merit"] for row in history]
        figures["history"] = lambda: history_figure(
            merits, damping if any(value == value for value in damping) else None
        )
    return figures


def pupil_note(settings: MeritSettings) -> str:
    """Return lines for titles that name the rays of `rms_spot_um`, if they are not the figure's.

    The figures' rays fill the stop evenly, and radii count from each colour's own centroid.

    Args:
        settings: of `rms_spot_um`.

    Returns:
        Lines, each with a line break before it; empty where only the number of rays differs.
    """
    notes = []
    if settings.sampling == "square_grid":
        options = settings.sampling_options
        count = options.get("count") or SQUARE_GRID_COUNT
        half_width = options.get("half_width")
        width = "the first surface" if half_width is None else f"±{half_width:g} mm"
        notes.append(f"{count}×{count} rays over {width}")
    if settings.reference_spectrum == "polychromatic":
        notes.append("one centroid for all colours")
    if settings.reference == "chief":
        notes.append("the chief ray as centre")
    return "\n(rms_spot_um: " + ",\n".join(notes) + ")" if notes else ""


def _size(field: tuple[float, float]) -> float:
    return field[0] ** 2 + field[1] ** 2


def _interval(wavelengths: list[float]) -> tuple[float, float]:
    """Return the range of wavelengths; about a single one, 5 % both ways."""
    low, high = min(wavelengths), max(wavelengths)
    return (low, high) if high > low else (0.95 * low, 1.05 * low)
