"""Field curvature and distortion are plotted side by side."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dolens.analysis.conditions import FieldScan
from dolens.analysis.field_curves import DISTORTION_REFERENCES, FieldCurves
from dolens.plotting.legends import legend_below
from dolens.plotting.style import (
    PAGE,
    SMALL,
    ruled_axes,
    spectral_colour,
    wavelength_handles,
)
from dolens.plotting.titles import draw_title

# Half widths of axes whose curves do not leave zero, mm and percent.
_FLAT, _UNDISTORTED = 1e-4, 0.01


def field_curves_figure(
    curves: FieldCurves | Sequence[FieldCurves], title: str | None = "Field curves"
) -> Figure:
    """Plot foci against the sensor at the left and distortion at the right, the field upwards.

    Tangential foci are solid and sagittal ones dashed, in the wavelengths' colours.

    Args:
        curves: of one scan, or of several (x and y of a lens without symmetry), a row each.
        title: above all.
    """
    rows = [curves] if isinstance(curves, FieldCurves) else list(curves)
    figure = Figure(figsize=(PAGE, 3.4 * len(rows) + 0.8), layout="constrained")
    grid = figure.subplots(len(rows), 2, squeeze=False, sharey="row", sharex="col")
    for (left, right), row in zip(grid, rows, strict=True):
        _foci(left, row)
        _distortion(right, row)
        left.set_ylabel(scan_label(row.scan), fontsize=SMALL + 1)
        for axes in (left, right):
            draw_field_limits(axes, row.scan)
    for axes in grid[-1]:
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=(1, 2, 2.5, 5, 10)))
    _widen(grid[0, 0], _FLAT)
    _widen(grid[0, 1], _UNDISTORTED)
    grid[-1, 0].set_xlabel("focus from the sensor (mm)", fontsize=SMALL + 1)
    grid[-1, 1].set_xlabel("distortion (%)", fontsize=SMALL + 1)
    grid[0, 0].set_title("Field curvature", fontsize=SMALL + 1)
    reference = rows[0].reference_wavelength
    ideal = DISTORTION_REFERENCES[rows[0].distortion_reference]
    grid[0, 1].set_title(f"Distortion from {ideal}, {reference:.4g} nm", fontsize=SMALL + 1)
    if rows[0].scan.field_unit != "°":
        grid[0, 1].set_title(f"Distortion, {reference:.4g} nm", fontsize=SMALL + 1)
    handles = [
        Line2D([], [], color="0.25", linewidth=1.4, label="tangential"),
        Line2D([], [], color="0.25", linewidth=1.4, linestyle="--", label="sagittal"),
        *wavelength_handles(rows[0].wavelengths),
    ]
    legend_below(figure, handles, 5)
    draw_title(figure, title)
    return figure


def scan_label(scan: FieldScan) -> str:
    """Return the name of a scan's coordinate with its unit."""
    unit = "degrees" if scan.field_unit == "°" else scan.field_unit
    along = f" along {scan.axis}" if scan.axis and float(scan.coordinate[0]) < 0.0 else ""
    return f"field{along} ({unit})"


def draw_field_limits(axes: Axes, scan: FieldScan) -> None:
    """Let the field fill the vertical axis, and rule zero."""
    axes.set_ylim(float(scan.coordinate.min()), float(scan.coordinate.max()))
    axes.axvline(0.0, color="0.6", linewidth=0.8, zorder=1)
    ruled_axes(axes)


def note_if_empty(axes: Axes, values: np.ndarray, text: str) -> None:
    """Write why axes hold no curve, where all values are NaN."""
    if np.isnan(values).all():
        axes.text(
            0.5, 0.5, text, ha="center", va="center", fontsize=SMALL, transform=axes.transAxes
        )


def _foci(axes: Axes, curves: FieldCurves) -> None:
    field = curves.scan.coordinate.numpy()
    for number, wavelength in enumerate(curves.wavelengths):
        colour = spectral_colour(float(wavelength))
        style: dict[str, Any] = {"color": colour, "linewidth": 1.4, "zorder": 3}
        axes.plot(curves.tangential[:, number], field, gid="tangential", **style)
        axes.plot(curves.sagittal[:, number], field, gid="sagittal", linestyle="--", **style)
    note_if_empty(axes, curves.tangential.numpy(), "no chief ray reaches the sensor")


def _distortion(axes: Axes, curves: FieldCurves) -> None:
    colour = spectral_colour(curves.reference_wavelength)
    field = curves.scan.coordinate.numpy()
    axes.plot(curves.distortion, field, color=colour, linewidth=1.4, gid="distortion", zorder=3)
    note_if_empty(axes, curves.distortion.numpy(), "no chief ray reaches the sensor")


def _widen(axes: Axes, least: float) -> None:
    """Show zero, and no narrower axis than ±least: rounding is no aberration."""
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -least), max(high, least))
