"""Coordinate breaks move and turn the axes of everything behind them; light does not meet them.

`broken_axes` gives the axes of the surfaces behind breaks in those of the lens.

The lens's axes are those of its first row, before any break: light comes towards +z.  All is in
double precision, whatever the lens's: a difference of places metres away keeps what surfaces need.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

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
from dolens.optics.surfaces.base import PackedShape, Parameters, by_names
from dolens.optics.surfaces.clear_aperture import ClearAperture, Unlimited
from dolens.optics.surfaces.plane import Plane
from dolens.optics.surfaces.state import SurfaceState

# What a break does, in the order of a prescription; mm and radians.
DECENTERS = ("decenter_x", "decenter_y")
BREAK = (*DECENTERS, *TILTS)
# Stands where code asks how far from the vertex light is expected, mm.
_NO_SIZE = 1e-6


class CoordinateBreak(Plane):
    """A coordinate break decentres the axes (mm), then turns them by R = Rx·Ry·Rz (radians).

    A point p in the axes behind it lies at d + R·p in the axes in front, with d = (decenter_x,
    decenter_y, 0): the axes move, then turn about x, about the new y, and about the new z, each
    right-handed.  Its thickness is along the new z.

    Args:
        parameters: any of `BREAK`; the others are zero.
        dtype: precision of the parameters.
    """

    kind = "coordinate_break"
    kernel = Plane.kernel
    closed_form = True
    changes_axes = True
    order: ClassVar[str] = "decenter_first"

    def __init__(
        self, parameters: Mapping[str, float] | None = None, dtype: torch.dtype = torch.float64
    ) -> None:
        numbers = {**dict.fromkeys(BREAK, 0.0), **dict(parameters or {})}
        super().__init__(ClearAperture(Unlimited(_NO_SIZE)), numbers, dtype)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the names of decenters and tilts."""
        return list(BREAK)

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return no numbers: kernels see the change of axes alone."""
        return PackedShape(())

    @classmethod
    def motion(cls, p: Parameters) -> tuple[Tensor, Tensor]:
        """Return shift (3,), mm, and rotation (3, 3) of the axes, double; in those in front."""
        return _shift(p), rotation_matrix(*(p[name].double() for name in TILTS))


class TiltFirstBreak(CoordinateBreak):
    """A coordinate break turns the axes by R = Rz·Ry·Rx, then decentres them along the new axes.

    It undoes a `CoordinateBreak` of the opposite numbers: the axes turn about z, the new y and the
    new x, and then move; a point p in the axes behind it lies at R·(d + p) in the axes in front.
    """

    kind = "coordinate_break"
    kernel = Plane.kernel
    closed_form = True
    changes_axes = True
    order = "tilt_first"

    @classmethod
    def motion(cls, p: Parameters) -> tuple[Tensor, Tensor]:
        """Return shift (3,), mm, and rotation (3, 3) of the axes, double; in those in front."""
        # Rz(c)·Ry(b)·Rx(a) is the transpose of Rx(-a)·Ry(-b)·Rz(-c).
        turn = rotation_matrix(*(-p[name].double() for name in TILTS)).mT
        return turn @ _shift(p), turn


# The order of a prescription → class.
BREAKS = {shape.order: shape for shape in (CoordinateBreak, TiltFirstBreak)}


def _shift(p: Parameters) -> Tensor:
    x, y = (p[name].double() for name in DECENTERS)
    return torch.stack([x, y, torch.zeros_like(x)])


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
    motions = [_motion(element, designed[element.place]) for element in elements]
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
