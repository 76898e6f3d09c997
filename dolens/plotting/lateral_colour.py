"""Chromatic aberrations are plotted: lateral colour over the field, focus over the wavelength."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dolens.analysis.lateral_colour import FocalShift, LateralColour
from dolens.plotting.field_curves import draw_field_limits, note_if_empty, scan_label
from dolens.plotting.legends import legend_below
from dolens.plotting.style import PAGE, SMALL, ruled_axes, spectral_colour
from dolens.plotting.titles import draw_title

_BAND = "#E8E8E8"


def lateral_colour_figure(
    colour: LateralColour | Sequence[LateralColour],
    focal_shift: FocalShift | None = None,
    title: str | None = "Chromatic aberrations",
) -> Figure:
    """Plot lateral colour, the field upwards, and the focus against the wavelength beside it.

    Grey bands are ± Airy's radius, and the depth of focus of ±2λN².

    Args:
        colour: of one scan, or of several (x and y of a lens without symmetry), a panel each.
        focal_shift: None to leave its panel out.
        title: above all.
    """
    scans = [colour] if isinstance(colour, LateralColour) else list(colour)
    panels = len(scans) + (focal_shift is not None)
    figure = Figure(figsize=(PAGE if panels > 1 else 4.2, 3.9), layout="constrained")
    grid = figure.subplots(1, panels, squeeze=False)[0]
    for axes, scan in zip(grid, scans, strict=False):
        _draw_lateral(axes, scan)
    if focal_shift is not None:
        _draw_shift(grid[-1], focal_shift)
    handles, labels = grid[0].get_legend_handles_labels()
    legend_below(figure, handles, 5, labels)
    draw_title(figure, title)
    return figure


def _draw_lateral(axes: Axes, colour: LateralColour) -> None:
    field = colour.scan.coordinate.numpy()
    airy = colour.airy_radius_um
    axes.axvspan(-airy, airy, color=_BAND, linewidth=0, zorder=0, label="± Airy radius")
    for number, wavelength in enumerate(colour.wavelengths):
        axes.plot(
            colour.shift_um[:, number],
            field,
            color=spectral_colour(float(wavelength)),
            linewidth=1.5,
            label=f"{float(wavelength):g} nm",
            gid="lateral colour",
            zorder=3,
        )
    note_if_empty(axes, colour.shift_um.numpy(), "no chief ray reaches the sensor")
    draw_field_limits(axes, colour.scan)
    axes.set_ylabel(scan_label(colour.scan), fontsize=SMALL + 1)
    axes.set_xlabel("image shift (µm)", fontsize=SMALL + 1)
    text = f"Lateral colour\nfrom {colour.reference_wavelength:.4g} nm"
    axes.set_title(text, fontsize=SMALL + 1)


def _draw_shift(axes: Axes, shift: FocalShift) -> None:
    waves, values = shift.wavelengths.numpy(), shift.shift_um.numpy()
    depth = shift.depth_of_focus_um
    if math.isfinite(depth):
        axes.axhspan(-depth, depth, color=_BAND, linewidth=0, zorder=0)
        # The band must not hide how the focus moves.
        reach = 1.15 * max(float(np.nanmax(np.abs(values))), 0.1 * depth)
        axes.set_ylim(-reach, reach)
    axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)
    axes.plot(waves, values, color="black", linewidth=1.5, gid="focal shift", zorder=3)
    axes.set_xlim(waves.min(), waves.max())
    axes.set_xlabel("wavelength (nm)", fontsize=SMALL + 1)
    axes.set_ylabel("paraxial focus (µm)", fontsize=SMALL + 1)
    text = "Focal shift"
    if math.isfinite(depth):
        text += f"\ngrey: ±2λN² = {depth:.3g} µm"
    axes.set_title(text, fontsize=SMALL + 1)
    ruled_axes(axes)
