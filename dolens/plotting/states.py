"""Figures of a lens in its states, one beside the other at one scale."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dolens.analysis.field_curves import FieldCurves
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.plotting.drawing import draw_layout, layout_drawing
from dolens.plotting.field_curves import scan_label
from dolens.plotting.layout import WIDTH, optics_text
from dolens.plotting.legends import legend_below
from dolens.plotting.lens_section import section_angles
from dolens.plotting.style import PAGE, SMALL, ruled_axes, spectral_colour
from dolens.plotting.titles import draw_title

# Inches: of a section at the least, and of what stands beside it.
_LOWEST, _BESIDE, _HEADING = 0.9, 0.95, 0.45


@torch.no_grad()
def states_layout_figure(
    states: Mapping[str, Lens], rays: int = 5, title: str | None = None
) -> Figure:
    """Draw the sections of a lens in its states, one below the other at one scale.

    The sensors stand below each other, so that what moves between two drawings is a group of
    surfaces.  Each state has the rays of its own fields and object distance.

    Args:
        states: name → the lens in that state (`Lens.in_state`).
        rays: of each field.
        title: above all.

    Raises:
        InputError: there are no states, or one cannot be drawn; see `layout_figure`.
    """
    if not states:
        raise InputError("states_layout_figure needs one state or more")
    drawings, ends = {}, {}
    for name, lens in states.items():
        points = [(0.0, 0.0)] if lens.fields is None else lens.fields.points
        heights = list(dict.fromkeys(y for x, y in points if x == 0.0)) or [0.0]
        distance = lens.object_distance
        wave = lens.primary_wavelength
        angles = section_angles(lens, heights, wave, distance)
        drawings[name] = layout_drawing(lens, wave, angles, rays, distance)
        ends[name] = float(lens.system().vertices[-1])
    before = max(ends[name] - d.z_limits[0] for name, d in drawings.items())
    behind = max(d.z_limits[1] - ends[name] for name, d in drawings.items())
    half_height = max(drawing.half_height for drawing in drawings.values())
    drawn = (WIDTH - _BESIDE) * 2.0 * half_height / (before + behind)
    height = min(max(drawn, _LOWEST), 2.0) + _HEADING
    figure = Figure(figsize=(WIDTH, height * len(states) + 0.6), layout="constrained")
    grid = figure.subplots(len(states), 1, squeeze=False)[:, 0]
    for axes, (name, drawing) in zip(grid, drawings.items(), strict=True):
        limits = (ends[name] - before, ends[name] + behind)
        draw_layout(axes, drawing, limits, half_height, legend=False)
        lens = states[name]
        optics = optics_text(drawing.system, lens.primary_wavelength, lens.object_distance)
        if lens.object_distance is not None:
            optics += f", object at {lens.object_distance:.4g} mm"
        axes.set_title(f"{name}: {optics}", fontsize=SMALL + 1)
    for axes in grid[:-1]:
        axes.set_xlabel("")
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
    for column, (name, curves) in enumerate(states.items()):
        number = int((curves.wavelengths - curves.reference_wavelength).abs().argmin())
        field = curves.scan.coordinate.numpy()
        style = {"color": spectral_colour(curves.reference_wavelength), "linewidth": 1.4}
        above, below = grid[:, column]
        above.plot(curves.tangential[:, number].numpy(), field, gid="tangential", **style)
        above.plot(
            curves.sagittal[:, number].numpy(), field, gid="sagittal", linestyle="--", **style
        )
        below.plot(curves.distortion.numpy(), field, gid="distortion", **style)
        above.set_title(name, fontsize=SMALL + 1)
        for axes in (above, below):
            axes.set_ylim(float(np.min(field)), float(np.max(field)))
            axes.axvline(0.0, color="0.6", linewidth=0.8, zorder=1)
            axes.xaxis.set_major_locator(MaxNLocator(3, steps=(1, 2, 5, 10)))
            ruled_axes(axes)
        above.set_xlabel("focus (mm)", fontsize=SMALL)
        below.set_xlabel("distortion (%)", fontsize=SMALL)
    labels = [scan_label(curves.scan) for curves in states.values()]
    for column, label in enumerate(labels):
        if column == 0 or label != labels[column - 1]:
            for axes in grid[:, column]:
                axes.set_ylabel(label, fontsize=SMALL + 1)
    handles: Sequence[Line2D] = [
        Line2D([], [], color="0.25", linewidth=1.4, label="tangential"),
        Line2D([], [], color="0.25", linewidth=1.4, linestyle="--", label="sagittal"),
    ]
    legend_below(figure, handles, 2)
    draw_title(figure, title)
    return figure
