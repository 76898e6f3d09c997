"""A small section of a lens stands beside others, with real rays and without axes."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes

from dolens.analysis.conditions import conditions
from dolens.optics.elements import to_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.optics.surfaces.clear_aperture import Unlimited
from dolens.plotting.drawing import Fan, LayoutDrawing, draw_layout, layout_drawing

# Of the line widths of a large drawing.
_LINES = 0.5
# Surfaces without an edge of their own are drawn so much farther than the rays go.
_MARGIN = 1.06


class SmallSection(NamedTuple):
    """A `SmallSection` holds a section of a lens with real rays, mm.

    Attributes:
        drawing: the section.
        z_limits: of axes that hold everything.
        half_height: of axes that hold everything.
    """

    drawing: LayoutDrawing
    z_limits: tuple[float, float]
    half_height: float


@torch.no_grad()
def small_section(lens: Lens, beams: Mapping[float, Sequence[float]]) -> SmallSection:
    """Section a lens, at its reference wavelength and object distance.

    Surfaces that clip nothing are drawn as far as the rays go.

    Args:
        lens: the lens.
        beams: field along y (degrees or mm) → heights on the stop, over its semi-diameter, of the
            rays that are drawn.
    """
    where = conditions(lens)
    wave, distance = where.reference_wavelength, where.object_distance
    paths = {field: _paths(lens, field, heights) for field, heights in beams.items()}
    drawing = layout_drawing(_fitted(lens, list(paths.values())), wave, (0.0,), 1, distance)
    start = drawing.z_limits[0]
    fans = [Fan(field, wave, _led(rays, start, drawing.height)) for field, rays in paths.items()]
    return SmallSection(drawing._replace(fans=fans), *_extent(drawing, fans))


def draw_small_section(axes: Axes, section: SmallSection) -> None:
    """Draw a section with thin lines into axes without ticks, at equal scales."""
    draw_layout(axes, section.drawing, section.z_limits, section.half_height, legend=False)
    for line in axes.lines:
        line.set_linewidth(_LINES * line.get_linewidth())
    axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
    axes.set_axis_off()


def _paths(lens: Lens, field: float, heights: Sequence[float]) -> np.ndarray:
    """Return points (rays, points, 3), mm, of real rays that cross the stop at these heights.

    They are in the lens's axes, and on surfaces alone, not on coordinate breaks.  The first point
    lies on the first surface's side of the object, 1 mm in front of it.
    """
    where = conditions(lens)
    wave, distance = where.reference_wavelength, where.object_distance
    pupil = torch.tensor([(0.0, height) for height in heights], dtype=lens.dtype)
    aimed = lens.aim((0.0, field), pupil, wave, distance)
    rays = Rays(aimed.position, aimed.direction, wave)
    traced = lens.trace(rays, record=True)
    assert traced.points is not None  # they were recorded
    ok = aimed.converged & traced.valid
    system = lens.system()
    surfaces = [traced.points[number - 1] for number in system.met]
    # A traced ray is in the sensor's axes, with the z of an unfolded lens.
    end = traced.components()
    end = to_lens_axes(end._replace(z=end.z - system.vertices[-1]), system.all_axes[-1])
    sensor = torch.stack(end[:3], -1)
    points = torch.stack([surfaces[0] - rays.direction, *surfaces, sensor], -2)
    return points[ok].double().cpu().numpy()


def _led(paths: np.ndarray, start: float, longest: float) -> np.ndarray:
    """Return paths whose first point is where the drawing starts, or so far in front of the lens:
    rays of wide fields would leave the drawing.
    """
    paths = paths.copy()
    first, towards = paths[:, 1], paths[:, 1] - paths[:, 0]
    length = np.minimum((first[:, 2:] - start) / towards[:, 2:], longest)
    paths[:, 0] = first - length * towards
    return paths


def _fitted(lens: Lens, paths: list[np.ndarray]) -> Lens:
    """Return the lens with surfaces that clip nothing drawn as far as these rays go.

    Their own sizes hold whole beams of the edge of the field, which a real lens vignettes.
    """
    lit = [rays for rays in paths if len(rays)]
    if not lit or not lens.system().rotationally_symmetric:
        return lens
    fitted = copy.deepcopy(lens)
    heights = np.max([np.abs(rays[:, 1:-1, 1]).max(0) for rays in lit], 0)
    for height, surface in zip(heights, fitted.surfaces.values(), strict=True):
        if not surface.aperture.clips and height > 0.0:
            size = min(_MARGIN * float(height), surface.semi_diameter)
            surface.aperture = replace(surface.aperture, edge=Unlimited(size))
    return fitted


def _extent(drawing: LayoutDrawing, fans: list[Fan]) -> tuple[tuple[float, float], float]:
    """Return limits in z and the half height, mm, that hold the lens and its rays."""
    lit = [fan.paths for fan in fans if len(fan.paths)]
    reach = [drawing.half_height, *(float(np.abs(paths[..., 1]).max()) for paths in lit)]
    return drawing.z_limits, max(value for value in reach if math.isfinite(value))
