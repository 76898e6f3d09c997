"""Elements: groups of neighbouring surfaces that move as one rigid body, and surfaces' axes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dolens.errors import InputError, check_keys
from dolens.kernels.table import GRAZING
from dolens.optics.rays import Components, distance_along

TILTS = ("tilt_x", "tilt_y", "tilt_z")
DISPLACEMENTS = ("decenter_x", "decenter_y", "shift_z")
POSE = (*TILTS, *DISPLACEMENTS)

Points = tuple[Tensor, Tensor, Tensor]  # x, y, z


class Element(nn.Module):
    """State of an element: which surfaces it holds, and its pose.

    The pose moves a point p of the lens as designed to c + R·(p - c) + d: a rotation
    R = Rx·Ry·Rz (right-handed, z first) about the pivot c, then a displacement d.

    Args:
        first: number of its first surface.
        last: number of its last surface.
        pose: any of `tilt_x`, `tilt_y`, `tilt_z` (radians), `decenter_x`, `decenter_y`, `shift_z`
            (mm); the others are zero.
        pivot: mm, from the vertex of its first surface as designed.
        dtype: precision of the parameters.

    Raises:
        InputError: no surface, or a pose of another name.
    """

    def __init__(
        self,
        first: int,
        last: int,
        pose: Mapping[str, float] | None = None,
        pivot: Sequence[float] = (0.0, 0.0, 0.0),
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if not 1 <= first <= last:
            raise InputError(f"an element's surfaces run from its first to its last: {first, last}")
        pose = dict(pose or {})
        check_keys(pose, POSE, "pose")
        self.first, self.last = first, last
        x, y, z = (float(value) for value in pivot)
        self.pivot = (x, y, z)
        for name in POSE:
            value = torch.tensor(float(pose.get(name, 0.0)), dtype=dtype)
            self.register_parameter(name, nn.Parameter(value))


@dataclass(frozen=True)
class ElementState:
    """An element as pure functions see it; see `Element`.

    Attributes:
        first: number of its first surface.
        last: number of its last surface.
        parameters: of its pose.
        pivot: mm, from the vertex, as designed, of the surface `origin`.
        origin: number of a surface; None: the first.  Light that comes back to an element meets
            other surfaces of it first.
    """

    first: int
    last: int
    parameters: Mapping[str, Tensor]
    pivot: tuple[float, float, float]
    origin: int | None = None

    @property
    def place(self) -> int:
        """Return the place, from 0, of the surface whose vertex the pivot counts from."""
        return (self.first if self.origin is None else self.origin) - 1


class Axes(NamedTuple):
    """The axes of a surface: a point p in them lies at origin + rotation·p in the lens's.

    Attributes:
        elements: indices of the elements that carry it, innermost first.
        z: of the vertex as designed, mm.
        rotation: (3, 3), or None where nothing carries the surface.
        origin: the vertex, (3,), mm, or None: (0, 0, z).
        segment: how many coordinate breaks stand in front; behind one, rotation and origin are
            double.
    """

    elements: tuple[int, ...]
    z: Tensor | float
    rotation: Tensor | None = None
    origin: Tensor | None = None
    segment: int = 0

    def place(self, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
        """Return rotation (3, 3) and origin (3,), mm, in double precision."""
        if self.rotation is None:
            z = torch.as_tensor(self.z, dtype=torch.float64, device=device)
            zero = torch.zeros_like(z)
            return torch.eye(3, dtype=z.dtype, device=device), torch.stack([zero, zero, z])
        assert self.origin is not None  # as there is a rotation
        return self.rotation.double(), self.origin.double()

    def together(self, other: "Axes") -> bool:
        """Return whether these axes and others lie along one line, and differ in z alone."""
        return self.elements == other.elements and self.segment == other.segment


class Motion(NamedTuple):
    """An element's pose moves a point p to pivot + turn·(p - pivot) + displacement.

    Attributes:
        turn: (3, 3).
        pivot: (3,), mm.
        displacement: (3,), mm.
    """

    turn: Tensor
    pivot: Tensor
    displacement: Tensor

    def moved(self, point: Tensor) -> Tensor:
        """Return where a point (3,), mm, goes."""
        return self.pivot + self.turn @ (point - self.pivot) + self.displacement


LENS_AXES = Axes((), 0.0)


def check_elements(elements: Mapping[str, Element], surfaces: int) -> None:
    """Raise `InputError` where an element leaves the lens, or two overlap without nesting."""
    for name, a in elements.items():
        if a.last > surfaces:
            raise InputError(
                f"element {name}: surface {a.last} is not in the lens, which has {surfaces}"
            )
        for other, b in elements.items():
            if other == name or a.last < b.first or b.last < a.first:
                continue
            same = (a.first, a.last) == (b.first, b.last)
            nested = (a.first <= b.first and b.last <= a.last) or (
                b.first <= a.first and a.last <= b.last
            )
            if same or not nested:
                raise InputError(
                    f"elements {name} (surfaces {a.first} to {a.last}) and {other} ({b.first} to "
                    f"{b.last}) overlap; one may lie inside another"
                )


def rotation_matrix(tilt_x: Tensor, tilt_y: Tensor, tilt_z: Tensor) -> Tensor:
    """Rx·Ry·Rz, (3, 3), right-handed, angles in radians."""
    cx, sx = torch.cos(tilt_x), torch.sin(tilt_x)
    cy, sy = torch.cos(tilt_y), torch.sin(tilt_y)
    cz, sz = torch.cos(tilt_z), torch.sin(tilt_z)
    rows = [
        (cy * cz, -cy * sz, sy),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy),
    ]
    return torch.stack([torch.stack(row) for row in rows])


def carriers(spans: Sequence[tuple[int, int]], number: int) -> tuple[int, ...]:
    """Find the elements that carry a surface, innermost first, by their first and last surfaces."""
    inner_first = sorted(range(len(spans)), key=lambda e: (spans[e][1] - spans[e][0], e))
    return tuple(e for e in inner_first if spans[e][0] <= number <= spans[e][1])


def surface_axes(
    elements: Sequence[ElementState], vertices: Sequence[Tensor], surfaces: int
) -> list[Axes]:
    """The axes of every surface.

    Args:
        elements: where they nest, the inner one moves within the outer one.
        vertices: z of every vertex as designed, mm.
        surfaces: how many.
    """
    motions = [_motion(element, vertices) for element in elements]
    spans = [(element.first, element.last) for element in elements]
    axes = []
    for number in range(1, surfaces + 1):
        z = vertices[number - 1]
        carried = carriers(spans, number)
        if not carried:
            axes.append(Axes((), z))
            continue
        zero = torch.zeros_like(z)
        origin = torch.stack([zero, zero, z])
        rotation = None
        for e in carried:
            origin = motions[e].moved(origin)
            rotation = motions[e].turn if rotation is None else motions[e].turn @ rotation
        axes.append(Axes(carried, z, rotation, origin))
    return axes


def relative_axes(now: Axes, then: Axes) -> tuple[Tensor, Tensor]:
    """From the axes of one surface to those of another, of which at least one is carried.

    Returns:
        step (3,), mm: from vertex to vertex, along the axes `now`; and turn (3, 3): a direction v
        along `now` is turn·v along `then`.  Both are double where a coordinate break stands in
        front of one of the two.
    """
    like = then.rotation if now.rotation is None else now.rotation
    assert like is not None  # at least one is carried
    step = _origin(then, like) - _origin(now, like)
    if now.rotation is None:
        return step, like.mT
    step = now.rotation.mT @ step
    return step, now.rotation if then.rotation is None else then.rotation.mT @ now.rotation


def change_axes(ray: Components, now: Axes, then: Axes) -> tuple[Components, Tensor | None]:
    """Rays in the axes of one surface, seen from those of the next.

    Within one element, and between surfaces that nothing carries, only z changes, unless a
    coordinate break stands between them.  Otherwise the rays are first carried along their line to
    the level of the next vertex: turning a point that is metres away would lose in float32 what the
    lens needs.  Rays that run along that level never reach it, and are turned where they are.

    Args:
        ray: mm, in the axes `now`.
        now: where the rays are.
        then: where they go.

    Returns:
        The rays in the axes `then`, and the distance (mm) that they were carried, or None.
    """
    x, y, z, l, m, n = ray  # noqa: E741
    if now.together(then):
        return Components(x, y, z + (now.z - then.z), l, m, n), None
    step, turn = (found.to(n.dtype) for found in relative_axes(now, then))
    along = n.abs() <= GRAZING
    below = step[2] - z
    distance = distance_along(below, n.masked_fill(along, 1.0))
    distance = distance.masked_fill(along, 0.0)
    near = (torch.addcmul(x - step[0], distance, l), torch.addcmul(y - step[1], distance, m))
    # Now (near, 0) counts from the next vertex, still along the axes `now`.
    position = _turn(turn, near[0], near[1], -below.masked_fill(~along, 0.0))
    return Components(*position, *_turn(turn, l, m, n)), distance


def to_lens_axes(ray: Components, axes: Axes) -> Components:
    """Rays in a surface's axes, seen from the lens's."""
    x, y, z, l, m, n = ray  # noqa: E741
    points = points_to_lens_axes((x, y, z), axes)
    if axes.rotation is None:
        return Components(*points, l, m, n)
    return Components(*points, *_turn(axes.rotation.to(n.dtype), l, m, n))


def points_to_lens_axes(points: Points, axes: Axes) -> Points:
    """Points (x, y, z) in a surface's axes, in mm, seen from the lens's."""
    x, y, z = points
    if axes.rotation is None:
        return x, y, z + axes.z
    assert axes.origin is not None  # as there is a rotation
    x, y, z = _turn(axes.rotation.to(z.dtype), x, y, z)
    ox, oy, oz = axes.origin.to(z.dtype).unbind()
    return x + ox, y + oy, z + oz


def from_lens_axes(ray: Components, axes: Axes) -> Components:
    """Rays in the lens's axes, seen from a surface's; the inverse of `to_lens_axes`."""
    x, y, z, l, m, n = ray  # noqa: E741
    points = points_from_lens_axes((x, y, z), axes)
    if axes.rotation is None:
        return Components(*points, l, m, n)
    return Components(*points, *_turn(axes.rotation.to(n.dtype).mT, l, m, n))


def points_from_lens_axes(points: Points, axes: Axes) -> Points:
    """Points in the lens's axes, seen from a surface's; the inverse of `points_to_lens_axes`."""
    x, y, z = points
    if axes.rotation is None:
        return x, y, z - axes.z
    assert axes.origin is not None  # as there is a rotation
    ox, oy, oz = axes.origin.to(z.dtype).unbind()
    return _turn(axes.rotation.to(z.dtype).mT, x - ox, y - oy, z - oz)


def _motion(element: ElementState, vertices: Sequence[Tensor]) -> Motion:
    """Rotation, pivot and displacement of one element."""
    p = element.parameters
    z = vertices[element.place]
    zero = torch.zeros_like(z)
    # Added as a tensor: a Python number makes a scalar double under torch.func's forward mode.
    pivot = torch.stack([zero, zero, z]) + z.new_tensor(element.pivot)
    displacement = torch.stack([p[name] for name in DISPLACEMENTS])
    return Motion(rotation_matrix(*(p[name] for name in TILTS)), pivot, displacement)


def _origin(axes: Axes, like: Tensor) -> Tensor:
    if axes.origin is not None:
        return axes.origin
    z = torch.as_tensor(axes.z, dtype=like.dtype, device=like.device)
    zero = torch.zeros_like(z)
    return torch.stack([zero, zero, z])


def _turn(r: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Points:
    a, b, c = (torch.addcmul(torch.addcmul(r[i, 0] * x, r[i, 1], y), r[i, 2], z) for i in range(3))
    return a, b, c
