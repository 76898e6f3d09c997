"""Curves over the field and the wavelength are plotted: field curvature, distortion, chromatic
aberrations, RMS spot radii and relative illumination.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from dolens.analysis.conditions import FieldScan
from dolens.analysis.field_curves import DISTORTION_REFERENCES, FieldCurves
from dolens.analysis.lateral_colour import FocalShift, LateralColour
from dolens.analysis.spot_diagram import RMSCurves
from dolens.diffraction.illumination import Illumination
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.plotting.style import (
    DASHES,
    PAGE,
    PALETTE,
    SMALL,
    draw_title,
    legend_below,
    ordered_colours,
    ruled_axes,
    spectral_colour,
    wavelength_handles,
)

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
    legend_below(figure, [*_foci_handles(), *wavelength_handles(rows[0].wavelengths)], 5)
    draw_title(figure, title)
    return figure


def states_field_curves_figure(
    states: Mapping[str, FieldCurves], title: str | None = None
) -> Figure:
    """Plot field curvature above and distortion below, a column for every state, at one scale.

    Tangential foci are solid and sagittal ones dashed, at the reference wavelength.

    Args:
        states: name → curves of the lens in that state.
        title: above all.

    Raises:
        InputError: there are no states.
    """
    if not states:
        raise InputError("states_field_curves_figure needs one state or more")
    figure = Figure(figsize=(PAGE, 4.6), layout="constrained")
    grid = figure.subplots(2, len(states), squeeze=False, sharex="row")
    labelled = ""
    for (above, below), (name, curves) in zip(grid.T, states.items(), strict=True):
        nearest = int((curves.wavelengths - curves.reference_wavelength).abs().argmin())
        _foci(above, curves, [nearest])
        _distortion(below, curves)
        above.set_title(name, fontsize=SMALL + 1)
        label = scan_label(curves.scan)
        for axes in (above, below):
            draw_field_limits(axes, curves.scan)
            axes.xaxis.set_major_locator(MaxNLocator(3, steps=(1, 2, 5, 10)))
            axes.set_ylabel("" if label == labelled else label, fontsize=SMALL + 1)
        labelled = label
        above.set_xlabel("focus (mm)", fontsize=SMALL)
        below.set_xlabel("distortion (%)", fontsize=SMALL)
    legend_below(figure, _foci_handles(), 2)
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


def _foci_handles() -> list[Line2D]:
    return [
        Line2D([], [], color="0.25", linewidth=1.4, label="tangential"),
        Line2D([], [], color="0.25", linewidth=1.4, linestyle="--", label="sagittal"),
    ]


def _foci(axes: Axes, curves: FieldCurves, wavelengths: Iterable[int] | None = None) -> None:
    """Draw the foci, at wavelengths of some numbers or at all."""
    field = curves.scan.coordinate.numpy()
    for number in range(len(curves.wavelengths)) if wavelengths is None else wavelengths:
        colour = spectral_colour(float(curves.wavelengths[number]))
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


def illumination_figure(
    illumination: Illumination | Sequence[Illumination],
    title: str | None = "Relative illumination",
) -> Figure:
    """Plot irradiance over that on the axis, in percent, with cos⁴ of the field for comparison.

    Args:
        illumination: of one scan, or of several, a panel each.
        title: above all.
    """
    panels = [illumination] if isinstance(illumination, Illumination) else list(illumination)
    figure = Figure(figsize=(PAGE if len(panels) > 1 else 5.4, 3.5), layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axes, curve in zip(grid, panels, strict=True):
        field = curve.scan.coordinate.numpy()
        fourth, relative = 100.0 * curve.cosine_fourth, 100.0 * curve.relative
        style = {"color": "0.5", "linewidth": 1.1, "linestyle": "--"}
        axes.plot(field, fourth, label="cos⁴ of the field", zorder=2, **style)
        style = {"color": PALETTE[0], "linewidth": 1.8, "gid": "illumination"}
        axes.plot(field, relative, label="relative illumination", zorder=3, **style)
        note_if_empty(axes, relative.numpy(), "no light passes on the axis")
        axes.set_xlim(field.min(), field.max())
        axes.set_xlabel(scan_label(curve.scan), fontsize=SMALL + 1)
        ruled_axes(axes)
    top = max([102.0, *(105.0 * float(c.relative.nan_to_num(0.0).max()) for c in panels)])
    grid[0].set_ylim(0.0, top)
    grid[0].set_ylabel("irradiance (% of the axis)", fontsize=SMALL + 1)
    handles, labels = grid[0].get_legend_handles_labels()
    legend_below(figure, handles, 2, labels)
    draw_title(figure, title)
    return figure
