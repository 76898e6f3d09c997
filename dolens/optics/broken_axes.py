"""The axes of surfaces behind coordinate breaks, in those of the lens.

The lens's axes are those of its first row, before any break: light comes towards +z.  All is in
double precision, whatever the lens's: a difference of places metres away keeps what surfaces need.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.optics.elements import (
    DISPLACEMENTS,
    TILTS,
    Axes,
    ElementState,
    Motion,
    carriers,
    rotation_matrix,
)
from dolens.optics.surfaces.coordinate_break import CoordinateBreak
from dolens.optics.surfaces.state import SurfaceState


class GlobalAxes(NamedTuple):
    """The axes of every surface, and of the sensor behind them, in the lens's axes; double.

    A point p in the axes of surface n lies at origin[n - 1] + rotation[n - 1]·p in the lens's.

    Attributes:
        origin: (surfaces + 1, 3), mm, of the vertices; behind a break for a break's own.
        rotation: (surfaces + 1, 3, 3).
    """

    origin: Tensor
    rotation: Tensor


class _Place(NamedTuple):
    """A vertex as designed: where it lies, and how its axes are turned."""

    origin: Tensor
    rotation: Tensor


def broken_axes(
    surfaces: Sequence[SurfaceState],
    gaps: Sequence[Tensor],
    elements: Sequence[ElementState],
    vertices: Sequence[Tensor],
) -> list[Axes]:
    """Return the axes of every surface of a lens with breaks, and of its sensor last.

    The pose of an element counts in the axes of its first surface as designed, and moves what it
    holds as one body, breaks and all; a break moves what stands behind it, elements and all.

    Args:
        surfaces: some of them breaks.
        gaps: behind each surface, mm; the last to the sensor.
        elements: where they nest, the inner one moves within the outer one.
        vertices: z along the axis as if nothing broke it, mm; the last of the sensor.
    """
    designed = _designed(surfaces, gaps)
    motions = [_motion(element, designed[element.first - 1]) for element in elements]
    spans = [(element.first, element.last) for element in elements]
    found, segment = [], 0
    for number, (origin, rotation) in enumerate(designed, 1):
        broken = number <= len(surfaces) and surfaces[number - 1].shape.changes_axes
        carried = () if number > len(surfaces) else carriers(spans, number)
        for e in carried:
            origin, rotation = motions[e].moved(origin), motions[e].turn @ rotation
        segment += broken
        z = vertices[number - 1]
        if segment == 0 and not carried:
            found.append(Axes((), z))
        else:
            found.append(Axes(carried, z, rotation, origin, segment))
    return found


def _designed(surfaces: Sequence[SurfaceState], gaps: Sequence[Tensor]) -> list[_Place]:
    """Return the places of all vertices and of the sensor, without the poses of elements."""
    like = gaps[-1]
    origin = torch.zeros(3, dtype=torch.float64, device=like.device)
    rotation = torch.eye(3, dtype=torch.float64, device=like.device)
    places = []
    for surface, gap in zip(surfaces, gaps, strict=True):
        if issubclass(surface.shape, CoordinateBreak):
            shift, turn = surface.shape.motion(surface.parameters)
            origin, rotation = origin + rotation @ shift, rotation @ turn
        places.append(_Place(origin, rotation))
        origin = origin + rotation[:, 2] * gap.double()
    return [*places, _Place(origin, rotation)]


def _motion(element: ElementState, first: _Place) -> Motion:
    """Return rotation, pivot and displacement of an element, in the lens's axes."""
    p = element.parameters
    own = rotation_matrix(*(p[name].double() for name in TILTS))
    turn = first.rotation @ own @ first.rotation.mT
    pivot = first.origin + first.rotation @ first.origin.new_tensor(element.pivot)
    shift = torch.stack([p[name].double() for name in DISPLACEMENTS])
    return Motion(turn, pivot, first.rotation @ shift)
