"""RMS spot radii are plotted against field and against wavelength."""

from collections.abc import Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.analysis.rms_curves import RMSCurves
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.plotting.style import (
    DASHES,
    PAGE,
    SMALL,
    ordered_colours,
    ruled_axes,
    spectral_colour,
)
from dolens.plotting.titles import draw_title

# Lines that differ by less of the largest radius are one on paper.
_SAME = 2e-3

# Largest radii over the field and over the wavelength share a scale up to this ratio.
_COMPARABLE = 10.0


def rms_curves_figure(
    against_field: RMSCurves | None = None,
    against_wavelength: RMSCurves | None = None,
    title: str | None = "RMS spot radius",
) -> Figure:
    """Plot RMS spot radii, µm: at the left over the field, at the right over the wavelength.

    Both have one scale, unless one of them is ten times as large.

    Over the field every wavelength has a line, and all together a black one; over the wavelength
    every field has a line; fields whose lines are the same share one.  Airy's radius is grey: over
    the field, that of the middle wavelength.

    Args:
        against_field: None to leave its axes out.
        against_wavelength: None to leave its axes out.
        title: above all.

    Raises:
        InputError: neither is given.
    """
    given = [
        (curves, draw)
        for curves, draw in ((against_field, _over_field), (against_wavelength, _over_wavelength))
        if curves is not None
    ]
    if not given:
        raise InputError("rms_curves_figure needs curves against field or against wavelength")
    figure = Figure(figsize=(PAGE if len(given) > 1 else 4.8, 3.9), layout="constrained")
    figure.set_layout_engine("constrained", wspace=0.06)
    grid = figure.subplots(1, len(given), squeeze=False, sharey=_comparable(given))
    for axes, (curves, draw) in zip(grid[0], given, strict=True):
        draw(axes, curves)
        ruled_axes(axes)
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.16),
            ncols=2,
            frameon=False,
            fontsize=SMALL,
        )
    # A scale that both share is known when both are drawn.
    for axes in grid[0]:
        axes.set_ylim(bottom=0.0)
    grid[0, 0].set_ylabel("RMS spot radius (µm)", fontsize=SMALL + 1)
    draw_title(figure, title)
    return figure


def _comparable(given: Sequence[tuple[RMSCurves, object]]) -> bool:
    """Return whether all curves can be read on one scale."""
    largest = [float(curves.rms.nan_to_num(0.0).max()) for curves, _ in given]
    return max(largest) < _COMPARABLE * min(largest)


def _over_field(axes: Axes, curves: RMSCurves) -> None:
    place = _places(curves.fields).numpy()
    for wave, wavelength in enumerate(curves.wavelengths):
        axes.plot(
            place,
            1e3 * curves.rms[:, wave].numpy(),
            color=spectral_colour(float(wavelength)),
            linestyle=DASHES[wave % len(DASHES)],
            linewidth=1.3,
            label=f"{float(wavelength):g} nm",
        )
    if len(curves.wavelengths) > 1:
        together = 1e3 * curves.polychromatic.numpy()
        axes.plot(place, together, color="black", linewidth=1.8, label="all, common centroid")
    airy = 1e3 * float(torch.median(curves.airy_radius))
    axes.plot(place, [airy] * len(place), color="0.6", linewidth=2.5, label="Airy radius")
    axes.set_xlabel(_field_axis(curves), fontsize=SMALL + 1)
    axes.set_xlim(place.min(), place.max())


def _over_wavelength(axes: Axes, curves: RMSCurves) -> None:
    waves = curves.wavelengths.numpy()
    shades = ordered_colours(len(curves.fields))
    for number, names in _distinct(curves).items():
        axes.plot(
            waves,
            1e3 * curves.rms[number].numpy(),
            color=shades[number],
            linestyle=DASHES[number % len(DASHES)],
            linewidth=1.5,
            label=", ".join(names),
        )
    airy = 1e3 * curves.airy_radius.numpy()
    axes.plot(waves, airy, color="0.6", linewidth=2.5, label="Airy radius")
    axes.set_xlabel("wavelength (nm)", fontsize=SMALL + 1)
    axes.set_xlim(waves.min(), waves.max())


def _places(fields: Tensor) -> Tensor:
    """Return the fields' places (F,) along the direction of the last one, negative beyond the axis.

    Fields that do not lie along it are at their distances from the axis.
    """
    last = fields[-1]
    along = fields @ last / last.norm().clamp(min=1e-12)
    distance = fields.norm(dim=-1)
    return along if torch.allclose(along.abs(), distance) else distance


def _field_axis(curves: RMSCurves) -> str:
    """Return the label of the axis, with the direction of the fields."""
    x, y = curves.fields.unbind(-1)
    along = " along y" if not x.any() else (" along x" if not y.any() else "")
    return f"field{along} ({curves.field_unit})"


def _distinct(curves: RMSCurves) -> dict[int, list[str]]:
    """Return the fields whose lines differ, by number, each with the names of all that share it."""
    found: dict[int, list[str]] = {}
    scale = float(curves.rms.nan_to_num(0.0).abs().max())
    for number, (field, line) in enumerate(zip(curves.fields, curves.rms, strict=True)):
        alike: dict[str, Any] = {"rtol": 0.0, "atol": _SAME * scale, "equal_nan": True}
        twin = next((n for n in found if torch.allclose(curves.rms[n], line, **alike)), number)
        found.setdefault(twin, []).append(field_label(field, curves.field_unit))
    return found
