"""Ghosts are drawn: the section of one path, and the irradiance over the sensor."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.ghost_map import GhostMap
from dolens.analysis.ghosts import front_box, sensor_aperture
from dolens.optics.aiming import field_line, launch
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import field_label
from dolens.optics.ghost_paths import ghost_path_system, unfolded
from dolens.optics.lens import Lens
from dolens.optics.surfaces import GRAZING
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import transfer
from dolens.plotting.layout import WIDTH, draw_layout, drawn_height, layout_drawing
from dolens.plotting.section import ray_paths
from dolens.plotting.style import (
    PAGE,
    SMALL,
    draw_axes_title,
    draw_title,
    number_text,
    ordered_colours,
)

# Rays across the front surface of which those that arrive are looked for.
_TRIALS = 801
_COLOURS, _DECADES, _COLUMNS = "inferno", 4, 3


@torch.no_grad()
def ghost_section_figure(
    lens: Lens,
    path: Sequence[int],
    where: Conditions,
    rays: int = 9,
    title: str | None = None,
) -> Figure:
    """Draw the section of a lens in the y-z plane with the rays of one ghost.

    Rays have another colour behind each reflection.  Artists carry gids as those of
    `layout_figure`; rays are `ghost ray`.

    Args:
        lens: the lens.
        path: surfaces that reflect, in the order of the light.
        where: one field, and object distance; rays are of the reference wavelength.
        rays: evenly over the part of the front whose rays arrive.
        title: above the drawing.

    Raises:
        InputError: there is no such path, or the lens cannot be drawn; see `layout_figure`.
    """
    lens = in_double_precision(lens)
    wave = where.reference_wavelength
    drawing = layout_drawing(lens, wave, [0.0], 1)
    system = ghost_path_system(lens.system(), path, sensor_aperture(lens))
    points = _meridional(lens, system, where, rays, drawing.z_limits[0])
    height = max(float(np.abs(points[..., 1]).max(initial=0.0)), drawing.half_height)
    drawing = drawing._replace(fans=[], half_height=1.02 * height)
    figure = Figure(
        figsize=(WIDTH, drawn_height(drawing.z_limits, drawing.half_height, True)),
        layout="constrained",
    )
    axes = figure.add_subplot()
    draw_layout(axes, drawing, drawing.z_limits, drawing.half_height)
    # The first point of a ray is in front of the lens.
    way = unfolded(tuple(path), len(lens.surfaces))
    places = [system.met.index(place + 1) + 1 for place in sorted(way.bounces)]
    ends = [0, *places, points.shape[1] - 1]
    goals = [
        "the sensor" if number > len(lens.surfaces) else f"surface {number}"
        for number in (*path, len(lens.surfaces) + 1)
    ]
    handles = []
    shades = ordered_colours(len(goals))
    for leg, ((begin, end), goal) in enumerate(zip(pairwise(ends), goals, strict=True)):
        for ray in points[:, begin : end + 1]:
            z, y = ray[:, 2], ray[:, 1]
            axes.plot(z, y, color=shades[leg], linewidth=0.7, gid="ghost ray", zorder=3)
        label = f"{'back ' * (leg % 2)}to {goal}"
        handles.append(Line2D([], [], color=shades[leg], linewidth=1.2, label=label))
    axes.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        frameon=False,
        fontsize=SMALL,
        title="" if len(points) else "no ray arrives",
        title_fontsize=SMALL,
    )
    draw_axes_title(axes, title)
    return figure


def _meridional(
    lens: Lens, system: OpticalSystem, where: Conditions, rays: int, start: float
) -> np.ndarray:
    """Return points (rays, points, 3), mm, of rays across the front surface along y that arrive.

    Args:
        lens: in double precision.
        system: of the path.
        where: the field, and object distance.
        rays: how many at most.
        start: z in mm where rays begin, or at the object if that is nearer.
    """
    wave, field = where.reference_wavelength, where.fields[0].to(lens.device)
    distance = where.object_distance
    line, near = field_line(torch.deg2rad(field) if distance is None else field, distance)
    low, high = front_box(lens.system(), line, float(near))

    def trace(heights: Tensor) -> tuple[Tensor, Tensor]:
        """Heights in the plane that faces the object, (N,), to points and validity."""
        q = torch.stack((torch.zeros_like(heights), heights), -1)
        ray = launch(line, near, q)
        begin = start if distance is None else max(start, -distance)
        back = ((begin - ray.z) / ray.n.clamp(min=GRAZING)).clamp(max=0.0)
        return ray_paths(system, transfer(ray, back), wave)

    trials = torch.linspace(0.0, 1.0, _TRIALS).to(low) * (high[1] - low[1]) + low[1]
    passing = trials[trace(trials)[1]]
    if not len(passing):
        return np.zeros((0, len(system.met) + 2, 3))
    share = torch.linspace(0.0, len(passing) - 1, rays).round().long()
    return trace(passing[share])[0].cpu().numpy()


def ghost_map_figure(maps: Sequence[GhostMap], title: str | None = "Ghosts") -> Figure:
    """Show the irradiance of ghosts over the sensor, a panel for each source.

    A cross stands where the source's image does.

    Args:
        maps: of one sensor, at one scale.
        title: above all panels.
    """
    count = len(maps)
    columns = min(count, _COLUMNS)
    rows = math.ceil(count / columns)
    width = PAGE if columns > 1 else 4.8
    panel = (width - 1.0) / columns
    figure = Figure(figsize=(width, (panel + 0.55) * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    brightest = max(float(one.irradiance.max()) for one in maps) or 1.0
    norm = LogNorm(brightest * 10.0**-_DECADES, brightest)
    for number, axes in enumerate(grid.flat):
        if number >= count:
            axes.set_visible(False)
            continue
        _draw_map(axes, maps[number], norm)
        axes.set_xlabel("x (mm)", fontsize=SMALL + 1)
        if number % columns == 0:
            axes.set_ylabel("y (mm)", fontsize=SMALL + 1)
    bar = figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=grid, aspect=30, extend="min", shrink=0.8
    )
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label("irradiance / irradiance in front of the lens", fontsize=SMALL + 1)
    draw_title(figure, title)
    return figure


def _draw_map(axes: Axes, one: GhostMap, norm: LogNorm) -> None:
    half = 0.5 * one.width
    axes.imshow(
        one.irradiance.clamp(min=norm.vmin).numpy(),
        cmap=_COLOURS,
        norm=norm,
        origin="lower",
        extent=(-half, half, -half, half),
        interpolation="nearest",
        gid="ghosts",
    )
    if all(map(math.isfinite, one.image)):
        axes.plot(*one.image, "+", color="#56B4E9", markersize=9, markeredgewidth=1.2, gid="image")
    axes.set(xlim=(-half, half), ylim=(-half, half))
    axes.tick_params(labelsize=SMALL - 1)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=(1, 2, 5, 10)))
    error = number_text(100.0 * one.relative_error, 1)
    label = field_label(one.where.fields[0], one.where.field_unit)
    axes.set_title(f"source at {label}\nsampling error {error} %", fontsize=SMALL)
