"""Footprints are drawn surface by surface, rays within the outline of the clear aperture."""

import math
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dolens.analysis.footprint import Footprint
from dolens.optics.fields import field_label
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.plotting.style import PAGE, SMALL, colours, draw_title, legend_below, number_text

_COLUMNS = 4
# Points along each side of the grid on which outlines are found, and room about them.
_GRID, _ROOM = 241, 1.12


def footprint_figure(footprint: Footprint, title: str | None = "Footprints") -> Figure:
    """Draw where rays meet every surface, a panel each, with its clear aperture.

    Rays that pass the lens are dots in the colour of their field, rays that end at the surface grey
    crosses.  Surfaces that clip nothing have a dashed circle, of the light that is expected.

    Args:
        footprint: the data.
        title: above all panels.
    """
    count = len(footprint.surfaces)
    columns = min(count, _COLUMNS)
    rows = math.ceil(count / columns)
    width = PAGE if columns > 2 else max(1.0 + 2.6 * columns, 4.2)
    figure = Figure(figsize=(width, (width / columns + 0.35) * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    shades = colours(len(footprint.fields))
    for number, axes in enumerate(grid.flat):
        if number >= count:
            axes.set_visible(False)
            continue
        _draw(axes, footprint, number, shades)
        axes.set_xlabel("x (mm)", fontsize=SMALL)
        if number % columns == 0:
            axes.set_ylabel("y (mm)", fontsize=SMALL)
    passing = footprint.passes.any(1).tolist()
    handles = []
    for field, lit, colour in zip(footprint.fields, passing, shades, strict=True):
        note = "" if lit else " (no light passes)"
        label = field_label(field, footprint.field_unit) + note
        handles.append(Line2D([], [], color=colour, marker="o", linestyle="", label=label))
    if bool((footprint.clipped > 0.0).any()):
        handles.append(Line2D([], [], color="0.45", marker="x", linestyle="", label="ends here"))
    legend_below(figure, handles, 6)
    draw_title(figure, title)
    return figure


def _draw(axes: Axes, footprint: Footprint, number: int, shades: list[str]) -> None:
    aperture = footprint.apertures[number]
    points = footprint.points[number]
    for field, colour in zip(range(len(shades)), shades, strict=True):
        x, y = points[field][footprint.passes[field]].T.numpy()
        style: dict[str, Any] = {
            "markersize": 1.3,
            "markeredgewidth": 0.0,
            "zorder": 2,
            "gid": "rays",
        }
        axes.plot(x, y, "o", color=colour, alpha=0.6, rasterized=True, **style)
        ends = ~footprint.passes[field] & points[field].isfinite().all(-1)
        if number + 1 < len(footprint.surfaces):
            ends = ends & footprint.points[number + 1][field].isnan().any(-1)
        x, y = points[field][ends].T.numpy()
        axes.plot(x, y, "x", color="0.45", markersize=2.5, markeredgewidth=0.5, zorder=3)
    reach = _reach(aperture, points)
    _outline(axes, aperture, reach)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1.0)
    axes.tick_params(labelsize=SMALL - 1)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(3, steps=(1, 2, 5, 10)))
    widest = footprint.extent[number].nan_to_num(0.0).amax()
    if float(widest) > 0.0:
        beam = f"light to {number_text(float(widest), 4)} mm"
    else:
        beam = "no light passes"
    axes.set_title(f"surface {footprint.surfaces[number]}\n{beam}", fontsize=SMALL)


def _reach(aperture: ClearAperture, points: torch.Tensor) -> float:
    farthest = float(points.nan_to_num(0.0).abs().amax()) if points.numel() else 0.0
    return _ROOM * max(aperture.semi_diameter, min(farthest, 2.0 * aperture.semi_diameter))


def _outline(axes: Axes, aperture: ClearAperture, reach: float) -> None:
    """Draw where the aperture's margin is zero; a dashed circle where nothing clips."""
    step = torch.linspace(-reach, reach, _GRID, dtype=torch.float64)
    y, x = torch.meshgrid(step, step, indexing="ij")
    if not aperture.clips:
        angle = np.linspace(0.0, 2.0 * math.pi, 181)
        style: dict[str, Any] = {"color": "0.5", "linewidth": 0.9, "linestyle": "--", "zorder": 4}
        axes.plot(*(aperture.semi_diameter * f(angle) for f in (np.cos, np.sin)), **style)
    margin = aperture.margin(x, y).numpy()
    if margin.min() < 0.0 < margin.max():
        axes.contour(step, step, margin, (0.0,), colors="black", linewidths=1.0, zorder=5)
