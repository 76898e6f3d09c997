"""A lens is described in space: surfaces as meshes, glass between them, what obscurations block,
and rays of its fields.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from dolens.analysis.conditions import Conditions
from dolens.analysis.vignetting import VignettedPupils
from dolens.errors import InputError
from dolens.optics.elements import to_lens_axes
from dolens.optics.image_surface import image_reach
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.rays import Rays
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Ellipse, Outline
from dolens.optics.surfaces.obscurations import Ring, Spider, Together
from dolens.optics.surfaces.outlines import Point, Polygons
from dolens.optics.system import OpticalSystem

AZIMUTHS = 64
_ACROSS = 10
# Points (rows, columns, 2), mm, and whether each row is closed.
Sheet = tuple[np.ndarray, bool]


def edge_points(outline: Outline) -> np.ndarray:
    """Return x and y of an outline at even azimuths, (azimuths, 2); corners are kept.

    Of polygons it is the convex hull.
    """
    angle = np.linspace(0.0, 2.0 * math.pi, AZIMUTHS, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    if outline.rotational:
        return outline.semi_diameter * unit
    if isinstance(outline, Polygons):
        return _hull(np.array([vertex for polygon in outline.polygons for vertex in polygon]), unit)
    half = np.array(outline.extent)
    # Azimuths of a square hit all four corners; stretched, they hit those of the rectangle.
    if isinstance(outline, Ellipse):
        return half * unit
    return half * unit / np.abs(unit).max(-1, keepdims=True)


def blocked_sheets(aperture: ClearAperture) -> list[Sheet]:
    """Return grids of points that cover an aperture's obscuration, as far as the edge."""
    if aperture.obscuration is None:
        return []
    return _sheets(aperture.obscuration, aperture.center, aperture.semi_diameter)


def rings(edge: np.ndarray, inner: float = 0.0) -> np.ndarray:
    """Return rings of points (rings, azimuths, 2) out to an edge, of like areas between them.

    Args:
        edge: (azimuths, 2), about its centre.
        inner: share of it where they begin.
    """
    share = np.concatenate([[inner], np.sqrt(np.linspace(inner**2, 1.0, _ACROSS + 1)[1:])])
    return share[:, None, None] * edge


def _sheets(outline: Outline, center: Point, reach: float) -> list[Sheet]:
    match outline:
        case Together():
            cx, cy = center
            return [
                sheet
                for part, (x, y) in outline.parts
                for sheet in _sheets(part, (x + cx, y + cy), reach)
            ]
        case Spider():
            length = np.linspace(0.0, reach, _ACROSS + 1)[:, None]
            across = np.linspace(-0.5, 0.5, 3)[None, :] * outline.width
            arms = [
                np.stack([c * length - s * across, s * length + c * across], -1)
                for c, s in outline.directions
            ]
            return [(arm + np.array(center), False) for arm in arms]
        case Polygons():
            return [(sheet + np.array(center), False) for sheet in _trapezoids(outline)]
        case Ring():
            outer = min(outline.semi_diameter, reach)
            inner = outline.inner_semi_diameter / outer
            if inner >= 1.0:
                return []
            return [(rings(edge_points(Circle(outer)), inner) + np.array(center), True)]
        case _:
            return [(rings(edge_points(outline)) + np.array(center), True)]


def _trapezoids(outline: Polygons) -> list[np.ndarray]:
    """Return grids (rows, columns, 2) that cover polygons, between neighbouring vertices in y."""
    heights = sorted({y for polygon in outline.polygons for _, y in polygon})
    found = []
    for low, high in pairwise(heights):
        middle = 0.5 * (low + high)
        lines = []
        for (ax, ay), (bx, by) in outline.sides:
            if min(ay, by) <= low and high <= max(ay, by):
                slope = (bx - ax) / (by - ay)
                lines.append((ax + slope * (middle - ay), ax + slope * (low - ay), slope))
        lines.sort()
        y = np.linspace(low, high, _ACROSS + 1)
        for left, right in zip(lines[::2], lines[1::2], strict=False):
            ends = [x + slope * (y - low) for _, x, slope in (left, right)]
            share = np.linspace(0.0, 1.0, _ACROSS + 1)[None, :]
            x = ends[0][:, None] * (1.0 - share) + ends[1][:, None] * share
            found.append(np.stack([x, np.broadcast_to(y[:, None], x.shape)], -1))
    return found


def _hull(vertices: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return points (azimuths, 2) of the convex hull of vertices, in directions from its middle."""
    middle = vertices.mean(0)
    around = vertices - middle
    # A point of the hull at the share t of a direction: t·(u·n) ≤ max (v·n) for every normal n.
    angle = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)
    normals = np.stack([np.cos(angle), np.sin(angle)], -1)
    support = (around @ normals.T).max(0)
    along = unit @ normals.T
    share = np.where(along > 1e-9, support / np.where(along > 1e-9, along, 1.0), np.inf).min(1)
    return middle + share[:, None] * unit


_RINGS = 10
# Rays start this far in front of the lens, in units of the distance from lens to sensor.
_LEAD = 0.12
# Azimuths of the rays on the edge of a beam, and how far inside of it they run.
_RIM, _INSIDE = 8, 0.995
_ALONG = (0.33, 0.67)


@dataclass(frozen=True)
class Mesh:
    """A mesh of quadrilaterals, mm, in the lens's axes.

    Attributes:
        kind: `glass` (a refracting surface), `mirror`, `side` (of an element), `cap` (where the
            half in front of the plane x = 0 is cut away), `stop`, `block` (an obscuration) or
            `sensor`.
        positions: (rings, around, 3), float32; neighbours are joined.
        normals: (rings, around, 3), float32, unit vectors.
        closed: whether the last point of a ring is joined with the first.
    """

    kind: str
    positions: np.ndarray
    normals: np.ndarray
    closed: bool = True


@dataclass(frozen=True)
class Solid:
    """A lens in space.

    Attributes:
        meshes: of everything but rays.
        rims: (points, 3) each, mm: the edges of surfaces.
        rays: for each field, paths (points, 3), mm, from in front of the lens to the sensor.
    """

    meshes: list[Mesh]
    rims: list[np.ndarray]
    rays: list[list[np.ndarray]]


@torch.no_grad()
def solid(lens: Lens, where: Conditions, lit: Sequence[bool] | None = None) -> Solid:
    """Describe a lens in space with rays of its fields at the reference wavelength.

    Args:
        lens: in double precision, on the CPU.
        where: fields and the object's distance.
        lit: which fields' light passes; None: all.  Of a field in doubt no rays are drawn.
    """
    system = lens.system()
    lit = [True] * len(where.fields) if lit is None else list(lit)
    rays = _field_rays(lens, where, lit)
    meshes: list[Mesh] = []
    rims: list[np.ndarray] = []
    glass = [is_glass(system.materials[number]) for number in range(len(system.surfaces) + 1)]
    following = dict(system.neighbours)
    for number in system.met:
        surface = system.surfaces[number - 1]
        if number in system.mirrors:
            meshes.append(_surface_mesh(system, number, "mirror"))
            rims.append(_rim(system, number, close=True))
        elif glass[number - 1] or glass[number]:
            meshes.append(_surface_mesh(system, number, "glass"))
            rims.append(_rim(system, number, close=True))
        for sheet in blocked_sheets(surface.aperture):
            meshes.append(_sheet_mesh(system, number, "block", sheet))
        if number in following and glass[number]:
            meshes.extend(_sides(system, number, following[number]))
    meshes.append(_stop(system))
    meshes.append(_sensor(lens, rays))
    return Solid(meshes, rims, rays)


def _placed(system: OpticalSystem, number: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return points (..., 3) of a surface in the lens's axes, at x and y in its own."""
    return _turned(system, number, np.stack([x, y, _sag(system, number, x, y)], -1), True)


def _turned(system: OpticalSystem, number: int, vectors: np.ndarray, moved: bool) -> np.ndarray:
    """Return points (moved) or directions in a surface's axes in those of the lens."""
    rotation, origin = (part.numpy() for part in system.place(number))
    turned = vectors @ rotation.T
    return turned + origin if moved else turned


def _sag(system: OpticalSystem, number: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the sag (mm) of a surface at points (mm) of its axes."""
    surface = system.surfaces[number - 1]
    return surface.sag_and_slopes(torch.from_numpy(x), torch.from_numpy(y))[0].numpy()


def _edge(system: OpticalSystem, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a surface's edge about its centre, (azimuths, 2), and the centre, mm."""
    aperture = system.surfaces[number - 1].aperture
    center = (0.0, 0.0) if aperture.edge.rotational else aperture.center
    return edge_points(aperture.edge), np.array(center)


def _surface_mesh(system: OpticalSystem, number: int, kind: str) -> Mesh:
    """Return a surface over its clear aperture, ring by ring from its centre."""
    edge, center = _edge(system, number)
    return _sheet_mesh(system, number, kind, (rings(edge) + center, True))


def _sheet_mesh(system: OpticalSystem, number: int, kind: str, sheet: Sheet) -> Mesh:
    """Return the part of a surface over a grid of points."""
    points, closed = sheet
    x, y = (np.ascontiguousarray(points[..., axis]) for axis in (0, 1))
    surface = system.surfaces[number - 1]
    _, sx, sy, _ = surface.sag_and_slopes(torch.from_numpy(x), torch.from_numpy(y))
    normals = np.stack([-sx.numpy(), -sy.numpy(), np.ones_like(x)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return _mesh(
        kind,
        _placed(system, number, x, y),
        np.broadcast_to(_turned(system, number, normals, False), (*x.shape, 3)),
        closed,
    )


def _mesh(
    kind: str, positions: np.ndarray, normals: np.ndarray | None = None, closed: bool = True
) -> Mesh:
    """Return a mesh of rings (R, azimuths, 3); without normals, with those of its shape."""
    if normals is None:
        along = np.gradient(positions, axis=0)
        across = np.roll(positions, -1, 1) - np.roll(positions, 1, 1)
        normals = np.cross(across, along)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = normals / np.where(length > 0.0, length, 1.0)
    return Mesh(kind, positions.astype("<f4"), normals.astype("<f4"), closed)


def _rim(system: OpticalSystem, number: int, close: bool = False) -> np.ndarray:
    edge, center = _edge(system, number)
    points = _placed(system, number, *(center + edge).T.copy())
    return np.concatenate([points, points[:1]]) if close else points


def _sides(system: OpticalSystem, number: int, following: int) -> list[Mesh]:
    """Return the ground edge of the glass between two surfaces, and its section.

    The edge is a flat outwards, and a cylinder.
    Where the flat would cut through the larger surface, the edge is a straight cone.
    """
    front, back = _rim(system, number), _rim(system, following)
    sizes = [system.surfaces[n - 1].aperture.edge for n in (number, following)]
    axes = system.axes
    together = axes[number - 1].together(axes[following - 1])
    round_faces = all(size.rotational for size in sizes)
    small, large = number, following
    if sizes[0].semi_diameter >= sizes[1].semi_diameter:
        small, large = large, small
    ratio = max(size.semi_diameter for size in sizes) / min(size.semi_diameter for size in sizes)
    if together and round_faces and ratio > 1.0 + 1e-9:
        # The smaller face's rim, widened in its own plane.
        edge = edge_points(sizes[int(small == following)])
        rim = np.column_stack([edge, _sag(system, small, *edge.T)])
        wide = rim * np.array([ratio, ratio, 1.0])
        corner = _turned(system, small, wide, True)
        flat = _turned(system, small, rim, True)
        share = np.linspace(1.0 / ratio, 1.0, 8)[:, None]
        outer = edge_points(sizes[int(large == following)])
        beyond = _placed(system, large, share * outer[None, :, 0], share * outer[None, :, 1])
        axis = _turned(system, small, np.array([0.0, 0.0, 1.0]), False)
        # Along the small face's axis, from it to the large one.
        sense = math.copysign(1.0, float((_vertex(system, large) - _vertex(system, small)) @ axis))
        if float((sense * ((beyond - corner[None]) @ axis)).min()) >= 0.0:
            other = back if large == following else front
            ends = corner[[3 * AZIMUTHS // 4, AZIMUTHS // 4]]
            return [
                _mesh("side", np.stack([flat, corner])),
                _mesh("side", np.stack([corner, other])),
                _cap(system, (number, following), ends),
            ]
    return [_mesh("side", np.stack([front, back])), _cap(system, (number, following), None)]


def _vertex(system: OpticalSystem, number: int) -> np.ndarray:
    """Return the vertex (3,), mm, of a surface in the lens's axes."""
    return _turned(system, number, np.zeros(3), True)


def _cap(system: OpticalSystem, numbers: tuple[int, int], corners: np.ndarray | None) -> Mesh:
    """Return the section of the glass between two surfaces, between their profiles.

    Args:
        system: the lens.
        numbers: of the surfaces.
        corners: (2, 3), mm, where the ground edge turns, below and above; None where it does not.
    """
    share = np.linspace(-1.0, 1.0, 2 * _RINGS + 1)
    lines = []
    for n in numbers:
        edge, center = _edge(system, n)
        y = center[1] + share * np.abs(edge[:, 1]).max()
        lines.append(_placed(system, n, np.zeros_like(y), y))
    front, back = lines
    if corners is not None:
        # A triangle at either end, as quadrilaterals with two corners in one.
        front = np.concatenate([corners[:1], front, corners[1:]])
        back = np.concatenate([corners[:1], back, corners[1:]])
    positions = np.stack([front, back]).astype("<f4")
    normals = np.broadcast_to(np.array([-1.0, 0.0, 0.0], dtype="<f4"), positions.shape)
    return Mesh("cap", positions, normals, closed=False)


def _stop(system: OpticalSystem) -> Mesh:
    """Return a ring around the stop's edge, in the plane of its rim."""
    around, center = _edge(system, system.stop)
    largest = max(surface.semi_diameter for surface in system.surfaces)
    edge = center + around
    outer = center + around * (1.0 + 0.22 * largest / np.linalg.norm(around, axis=-1).max())
    sag = _sag(system, system.stop, *edge.T)
    rings = [np.column_stack([ring, sag]) for ring in (edge, outer)]
    return _mesh("stop", _turned(system, system.stop, np.stack(rings), True))


def _sensor(lens: Lens, rays: Sequence[Sequence[np.ndarray]]) -> Mesh:
    """Return the sensor: the prescription's image circle, or what holds all rays."""
    axes = lens.system().global_axes()
    rotation, origin = axes.rotation[-1].numpy(), axes.origin[-1].numpy()
    rays = [[(path - origin) @ rotation for path in field] for field in rays]
    ends = [np.hypot(*path[-1, :2]) for field in rays for path in field]
    reach = 0.5 * lens.sensor_diameter if lens.sensor_diameter else 1.1 * max(ends, default=1.0)
    image = lens.system().image
    if image is not None:
        reach = min(reach, image_reach(image))
    angle = np.linspace(0.0, 2.0 * math.pi, AZIMUTHS, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(AZIMUTHS)], -1) * max(reach, 1e-6)
    positions = np.stack([0.0 * ring, ring])
    if image is not None:
        positions = np.linspace(0.0, 1.0, _RINGS)[:, None, None] * ring
        x, y = torch.from_numpy(positions[..., 0]), torch.from_numpy(positions[..., 1])
        positions[..., 2] = image.sag_and_slopes(x, y)[0].numpy()
        return _mesh("sensor", positions @ rotation.T + origin)
    positions = positions @ rotation.T + origin
    return _mesh("sensor", positions, np.broadcast_to(-rotation[:, 2], positions.shape))


def _field_rays(lens: Lens, where: Conditions, lit: Sequence[bool]) -> list[list[np.ndarray]]:
    """Return rays on the edge of each field's beam, along two diameters and its middle."""
    which = [number for number, passes in enumerate(lit) if passes]
    rays: list[list[np.ndarray]] = [[] for _ in lit]
    if not which:
        return rays
    try:
        found = _beams(lens, where, which)
    except InputError:
        # Of one field too little light passes to find its beam: each is tried alone.
        if len(which) == 1:
            return rays
        for number in which:
            alone = [other == number for other in range(len(lit))]
            rays[number] = _field_rays(lens, where, alone)[number]
        return rays
    for number, paths in zip(which, found, strict=True):
        rays[number] = paths
    return rays


def _beams(lens: Lens, where: Conditions, which: Sequence[int]) -> list[list[np.ndarray]]:
    """Trace the rays of some fields together, since aiming costs by the call."""
    pupils = VignettedPupils(lens, where.fields[list(which)], where.object_distance)
    count = len(which)
    centre = pupils.centres(torch.zeros(count, dtype=torch.bool))
    angle = torch.arange(_RIM, dtype=torch.float64) * (2.0 * math.pi / _RIM)
    arms = torch.stack([angle.cos(), angle.sin()], -1).expand(count, -1, -1)
    reach = pupils.boundary_radius(centre, arms)[..., None]
    rim = centre[:, None] + _INSIDE * reach * arms
    quarter = max(_RIM // 4, 1)
    inner = [centre[:, None]]
    inner += [centre[:, None] + part * reach[:, ::quarter] * arms[:, ::quarter] for part in _ALONG]
    aimed = pupils.aim(torch.cat([rim, *inner], 1))
    hit = lens.trace(Rays(aimed.position, aimed.direction, aimed.wavelength), record=True)
    system = lens.system()
    end = hit.components()
    end = to_lens_axes(end._replace(z=end.z - system.vertices[-1]), system.all_axes[-1])
    met = [number - 1 for number in system.met]
    assert hit.points is not None  # they were recorded
    # (fields, rays, surfaces and sensor, 3)
    points = torch.cat([hit.points[met], torch.stack(end[:3], -1)[None]]).movedim(0, 2)
    passing = hit.valid & aimed.converged
    origins = system.global_axes().origin[:, 2]
    sensor = float(origins.max())
    front = min(0.0, float(points[passing][:, 0, 2].min())) if bool(passing.any()) else 0.0
    if system.mirrors or system.breaks:
        # In front of everything, and not only of the surface that light meets first.
        front = min(front, float(origins.min()))
        lead = front - _LEAD * (sensor - front)
    else:
        lead = front - _LEAD * sensor
    if where.object_distance is not None:
        lead = max(lead, -where.object_distance)
    start, along = aimed.position, aimed.direction
    begin = start + along * ((lead - start[..., 2:]) / along[..., 2:])
    paths = torch.cat([begin[:, :, None], points], 2)
    return [
        [path.numpy().astype("<f4") for path in of_field[there]]
        for of_field, there in zip(paths, passing, strict=True)
    ]
