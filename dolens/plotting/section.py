"""The meridional section of a lens is computed: surface profiles, edges of elements, ray fans."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.aiming import aim
from dolens.optics.elements import points_to_lens_axes
from dolens.optics.materials import is_glass
from dolens.optics.paraxial import entrance_pupil
from dolens.optics.rays import Components
from dolens.optics.surfaces import GRAZING
from dolens.optics.surfaces.clear_aperture import Circle
from dolens.optics.surfaces.outlines import Polygons
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import Crossing, trace_surfaces, trace_to_sensor, transfer

Profile = tuple[np.ndarray, np.ndarray]

SAMPLES = 201
# Places along a cut, where outlines may be of several parts.
_GRID = 2001
BISECTIONS = 60
_NEWTON_STEPS = 20


class SurfaceCut:
    """The plane x = 0 of the lens cuts a surface in a curve, along which a place is a number (mm).

    Raises:
        InputError: the surface faces along x.
    """

    def __init__(self, system: OpticalSystem, number: int) -> None:
        self.surface = system.surfaces[number - 1]
        self.rotation, self.origin = system.place(number)
        # In the surface's axes the plane is a·p + o = 0, with a the lens's x seen from the surface.
        ax, ay, self.az = self.rotation[0]
        self.offset = self.origin[0]
        self.across = torch.hypot(ax, ay)
        if float(self.across) < 1e-9:
            raise InputError(
                f"layout: surface {number} faces along x and has no meridional section"
            )
        self.ux, self.uy = ax / self.across, ay / self.across
        # Along the cut, y of the lens grows.
        rotation = self.rotation
        grows = float(rotation[1, 1] * self.ux - rotation[1, 0] * self.uy) >= 0.0
        sign = 1.0 if grows else -1.0
        self.vx, self.vy = -sign * self.uy, sign * self.ux

    def along(self, x: float, y: float) -> float:
        """Return the place nearest to a point of the surface's axes."""
        return float(self.vx) * x + float(self.vy) * y

    def points(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return x, y, sag in the surface's axes at places q, and where the sag exists."""
        across, offset, az = self.across, self.offset, self.az
        w = (-offset / across).expand_as(q)
        for _ in range(_NEWTON_STEPS if float(az.abs()) > 0.0 else 1):
            x, y = self.vx * q + self.ux * w, self.vy * q + self.uy * w
            sag, sx, sy, _ = self.surface.sag_and_slopes(x, y)
            slope = across + az * (sx * self.ux + sy * self.uy)
            w = w - (across * w + offset + az * sag) / torch.where(slope == 0.0, across, slope)
        x, y = self.vx * q + self.ux * w, self.vy * q + self.uy * w
        sag, _, _, exists = self.surface.sag_and_slopes(x, y)
        return x, y, sag, exists

    def profile(self, low: float, high: float) -> Profile:
        """Return z and y, mm, of the lens between two places."""
        share = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)
        x, y, sag, exists = self.points(low * (1.0 - share) + high * share)
        points = torch.stack([x, y, sag]).T[exists] @ self.rotation.T + self.origin
        return points[:, 2].numpy(), points[:, 1].numpy()


def runs(inside: Callable[[Tensor], Tensor], reach: float) -> list[tuple[float, float]]:
    """Return from where to where along a cut points are inside; gaps below a grid's are not seen.

    Args:
        inside: of places along the cut.
        reach: how far from the middle to look.
    """
    grid = torch.linspace(-1.01 * reach, 1.01 * reach, _GRID, dtype=torch.float64)
    state = inside(grid)
    change = torch.nonzero(state[1:] != state[:-1])[:, 0]
    low, high, first = grid[change], grid[change + 1], state[change]
    for _ in range(BISECTIONS):
        half = 0.5 * (low + high)
        same = inside(half) == first
        low, high = torch.where(same, half, low), torch.where(same, high, half)
    rims = torch.where(first, low, high).tolist()
    return list(zip(rims[::2], rims[1::2], strict=False))


# The real beam is looked for over this many paraxial pupil radii, because pupils have aberrations.
_SEARCH = 1.5
_TRIALS = 601
# Heights on the stop whose rays are tried where the lens is folded.
_STOP_TRIALS = 81
# Points of a ray in a gradient.
_BETWEEN = 24
# Points of a curved sensor.
_CURVE = 65
_NOTHING: Profile = (np.zeros(0), np.zeros(0))


def surface_profile(system: OpticalSystem, number: int) -> Profile:
    """Return the curve in which the plane x = 0 cuts a surface, over its clear aperture.

    Args:
        system: the lens; elements with any pose.
        number: of the surface, from 1.

    Returns:
        z and y in mm, (samples,), from the lower rim to the upper one; shorter where the sag
        branch ends before the aperture does, empty where the plane passes by the surface, and of a
        coordinate break.
    """
    if number in system.breaks:
        return _NOTHING
    aperture = system.surfaces[number - 1].aperture
    edge = aperture.edge.drawn
    center = (0.0, 0.0) if edge.rotational else aperture.center
    cut = SurfaceCut(system, number)

    def inside(q: Tensor) -> Tensor:
        x, y, _, _ = cut.points(q)
        return edge.margin(x - center[0], y - center[1]) >= 0.0

    if isinstance(edge, Polygons):
        found = runs(inside, aperture.semi_diameter)
        return cut.profile(found[0][0], found[-1][1]) if found else _NOTHING
    if isinstance(edge, Circle) and not (float(cut.az) or float(cut.offset)):
        return cut.profile(-edge.semi_diameter, edge.semi_diameter)
    # Along the cut, the place nearest to the outline's centre.
    begin = cut.along(*center)
    middle = torch.full((1,), begin, dtype=torch.float64)
    if not bool(inside(middle)):
        return _NOTHING
    # The rims: the last point inside on either side.
    near = middle.expand(2)
    far = begin + 1.5 * edge.semi_diameter * torch.tensor([-1.0, 1.0], dtype=torch.float64)
    for _ in range(BISECTIONS):
        half = 0.5 * (near + far)
        kept = inside(half)
        near, far = torch.where(kept, half, near), torch.where(kept, far, half)
    return cut.profile(*near.tolist())


def obscuration_profiles(system: OpticalSystem, number: int) -> list[Profile]:
    """Return the profiles over what the surface's obscuration blocks of its aperture."""
    aperture = system.surfaces[number - 1].aperture
    hole = aperture.obscuration
    if hole is None:
        return []
    reach = aperture.semi_diameter
    cut = SurfaceCut(system, number)

    def blocked(q: Tensor) -> Tensor:
        x, y, _, _ = cut.points(q)
        # Arms of a spider end at the edge.
        u, v = x - aperture.center[0], y - aperture.center[1]
        return (hole.margin(u, v) >= 0.0) & (torch.hypot(x, y) <= reach)

    return [cut.profile(*run) for run in runs(blocked, reach)]


def axis_angle(system: OpticalSystem, number: int) -> float:
    """Return the angle (radians) from z towards y of a surface's axis, seen along x."""
    rotation, _ = system.place(number)
    return math.atan2(float(rotation[1, 2]), float(rotation[2, 2]))


def element_edges(
    system: OpticalSystem, numbers: tuple[int, int], front: Profile, back: Profile
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ground edges, upper and lower, of the glass between two surfaces, (corners, 2) as
    z, y.

    They run along the axis of the element that carries both faces.
    """
    if not (system.breaks or system.elements):
        return ground_edge(front, back, -1), ground_edge(front, back, 0)
    number, other = numbers
    axes = system.axes
    together = axes[number - 1].together(axes[other - 1])
    angle = axis_angle(system, number) if together else 0.0
    faces = _turn(front, -angle), _turn(back, -angle)

    def edge(end: int) -> np.ndarray:
        z, y = ground_edge(*faces, end).T
        return np.stack(_turn((z, y), angle), -1)

    return edge(-1), edge(0)


def _turn(profile: Profile, angle: float) -> Profile:
    z, y = profile
    c, s = math.cos(angle), math.sin(angle)
    return c * z - s * y, s * z + c * y


def ground_edge(front: Profile, back: Profile, end: int) -> np.ndarray:
    """Return the ground edge of an element on one side (end -1: +y, 0: -y), (corners, 2) as z, y,
    along the axis.

    A flat from the smaller surface outwards, then a cylinder; a straight line where the flat
    would cut through the other surface.
    """
    a = np.array([front[0][end], front[1][end]])
    b = np.array([back[0][end], back[1][end]])
    corner = np.array([a[0], b[1]]) if abs(a[1]) < abs(b[1]) else np.array([b[0], a[1]])
    outer, inner = (back, front) if abs(a[1]) < abs(b[1]) else (front, back)
    beyond = np.abs(outer[1]) >= abs(inner[1][end])
    gap = (outer[0][beyond] - corner[0]) * (1.0 if outer is back else -1.0)
    return np.stack([a, b]) if gap.min(initial=np.inf) < 0.0 else np.stack([a, corner, b])


class GlassSection(NamedTuple):
    """The section of a piece of glass: points (N, 2) are z and y, mm.

    Attributes:
        number: of the surface in front.
        outline: of the glass, a closed polygon.
        edges: ground edges, upper and lower.
    """

    number: int
    outline: np.ndarray
    edges: tuple[np.ndarray, np.ndarray]


def glass_sections(system: OpticalSystem, profiles: Sequence[Profile]) -> list[GlassSection]:
    """Return the sections of all glass whose two surfaces have a profile.

    Args:
        system: the lens.
        profiles: of its surfaces in order, from the lower rim to the upper one.
    """
    found = []
    for number, other in system.neighbours:
        front, back = profiles[number - 1], profiles[other - 1]
        if is_glass(system.materials[number]) and len(front[0]) and len(back[0]):
            top, bottom = element_edges(system, (number, other), front, back)
            faces = np.stack(front, -1), np.stack(back, -1)[::-1]
            outline = np.concatenate([faces[0], top[1:-1], faces[1], bottom[1:-1][::-1]])
            found.append(GlassSection(number, outline, (top, bottom)))
    return found


def drawn_surfaces(system: OpticalSystem, profiles: Sequence[Profile]) -> list[int]:
    """Return the numbers of the surfaces that a section shows as curves.

    They are mirrors, faces of glass, and all others that bend light, but not a stop in air.
    """
    glass = {
        face for pair in system.neighbours if is_glass(system.materials[pair[0]]) for face in pair
    }
    return [
        number
        for number, profile in enumerate(profiles, 1)
        if len(profile[0])
        and (
            number in system.mirrors
            or number in glass
            or (system.refracts(number) and number != system.stop)
        )
    ]


def stop_bars(system: OpticalSystem, profile: Profile, length: float) -> list[np.ndarray]:
    """Return the ends (2, 2), as z and y, mm, of bars outside of the stop, upper and lower.

    They begin at the stop's edge and stand across its axis.

    Args:
        system: the lens.
        profile: of the stop.
        length: of a bar, mm.
    """
    z, y = profile
    if not len(z):
        return []
    angle = axis_angle(system, system.stop)
    bar = length * np.array([-math.sin(angle), math.cos(angle)])
    rims = ((np.array([z[end], y[end]]), side) for end, side in ((-1, 1.0), (0, -1.0)))
    return [np.stack([rim, rim + side * bar]) for rim, side in rims]


def trace_fan(
    system: OpticalSystem,
    wavelength: float,
    field_deg: float,
    rays: int,
    object_distance: float | None,
    start: float,
) -> np.ndarray:
    """Trace a meridional fan from an object point, over the entrance pupil, to the sensor.

    Args:
        system: the lens.
        wavelength: nm.
        field_deg: the angle of the chief ray in object space, degrees.
        rays: how many; one alone is the chief ray.
        object_distance: mm in front of the first vertex, or None for infinity.
        start: z in mm where the first point of every ray lies, or at the object if that is nearer;
            with light from the side not farther out than a little beyond the first surface.

    Returns:
        (valid rays, surfaces + 2, 3), mm, in the lens's axes: start, every surface that light
        meets, sensor.
    """
    if system.breaks or system.from_the_side:
        return _aimed_fan(system, wavelength, field_deg, rays, object_distance, start)
    pupil = entrance_pupil(system, wavelength)
    if object_distance is not None:
        if not (object_distance > 0.0 and object_distance + float(pupil.z) > 0.0):
            raise InputError(
                f"layout: object_distance {object_distance:g} mm must be positive, and in front "
                f"of the entrance pupil at z = {float(pupil.z):g} mm"
            )
        start = max(start, -object_distance)
    slope = math.tan(math.radians(field_deg))

    def trace(aim: Tensor) -> tuple[Tensor, Tensor]:
        """Heights in the pupil's plane, (N,), to (N, points, 3) and validity, (N,)."""
        if object_distance is None:
            slopes = torch.full_like(aim, slope)
        else:
            slopes = slope + aim / (pupil.z + object_distance)
        y = aim + slopes * (start - pupil.z)
        n = torch.rsqrt(1.0 + slopes * slopes)
        zero = torch.zeros_like(y)
        ray = Components(zero, y, zero + start, zero, slopes * n, n)
        return ray_paths(system, ray, wavelength)

    if rays == 1:
        aims = torch.zeros_like(pupil.z).reshape(1)
    else:
        reach = 0.5 * _SEARCH * pupil.diameter
        trials = torch.linspace(-1.0, 1.0, _TRIALS).to(reach) * reach
        passing = trials[trace(trials)[1]]
        if not len(passing):
            return np.zeros((0, len(system.met) + 2, 3))
        share = torch.linspace(0.0, 1.0, rays).to(reach)
        aims = passing[0] * (1.0 - share) + passing[-1] * share
    path, valid = trace(aims)
    return path[valid].double().cpu().numpy()


def ray_paths(
    system: OpticalSystem, ray: Components, wavelength: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Return the points (..., points, 3) of rays in the lens's axes, mm: where they begin, on every
    surface that light meets, on the sensor; and which reach it.  In gradients, where rays bend,
    there are points between surfaces.
    """
    crossings: list[Crossing] = []
    traced = trace_surfaces(system, ray, wavelength, record=True, crossings=crossings)
    landed = trace_to_sensor(system, traced, wavelength)
    end = landed.ray._replace(z=landed.ray.z - system.vertices[-1])
    spaces, met = system.spaces(wavelength), []
    for crossing, behind in zip(crossings, [*crossings[1:], None], strict=True):
        met.append(traced.points[crossing.number - 1])
        space = spaces.get(crossing.number)
        if space is not None and behind is not None:
            begin = Components(*crossing.point, *crossing.leaving)
            onward = traced.points[behind.number - 1]
            met += space.between(begin, crossing.axes, onward, _BETWEEN)
    points = [ray[:3], *met, points_to_lens_axes(end[:3], system.all_axes[-1])]
    return torch.stack([torch.stack(point, -1) for point in points], -2), landed.valid


def _aimed_fan(
    system: OpticalSystem,
    wavelength: float,
    field_deg: float,
    rays: int,
    object_distance: float | None,
    start: float,
) -> np.ndarray:
    """Trace a fan whose rays are aimed at the stop, wherever it stands; see `trace_fan`."""
    angle = math.radians(field_deg)
    along = angle
    if object_distance is not None:
        # The chief ray comes down from a point of the object, towards the first vertex.
        along = -math.tan(angle) * object_distance
        start = max(start, -object_distance)
    like = system.sensor_distance.detach()
    field = torch.stack([torch.zeros_like(like), torch.full_like(like, along)])

    def trace(heights: Tensor) -> tuple[Tensor, Tensor]:
        """Heights on the stop over its semi-diameter, (N,), to points and validity."""
        pupil = torch.stack([torch.zeros_like(heights), heights], -1)
        aimed = aim(system, field, pupil, wavelength, object_distance)
        ray = aimed.components()
        if system.from_the_side:
            longest = 1.2 * system.surfaces[system.met[0] - 1].semi_diameter
            lead = (ray.z - start) / ray.n.clamp(min=GRAZING)
            ray = transfer(ray, -lead.clamp(0.0, longest))
        else:
            ray = transfer(ray, (start - ray.z) / ray.n)
        points, valid = ray_paths(system, ray, wavelength)
        return points, valid & aimed.converged

    if rays == 1:
        heights = torch.zeros_like(like).reshape(1)
    else:
        trials = torch.linspace(-1.0, 1.0, _STOP_TRIALS).to(like) * (1.0 - 1e-9)
        passing = trials[trace(trials)[1]]
        if not len(passing):
            return np.zeros((0, len(system.met) + 2, 3))
        share = torch.linspace(0.0, 1.0, rays).to(like)
        heights = passing[0] * (1.0 - share) + passing[-1] * share
    path, valid = trace(heights)
    return path[valid].double().cpu().numpy()


def broken_axis(system: OpticalSystem) -> np.ndarray:
    """Return z and y (surfaces + 1, 2), mm, of the vertices that the axis leads through."""
    return system.global_axes().origin.detach().cpu().numpy()[:, [2, 1]]


def sensor_line(system: OpticalSystem, half: float) -> np.ndarray:
    """Return the ends z and y (2, 2), mm, of a line of half a length, along the sensor's y."""
    axes = system.global_axes()
    origin, along = (v[-1].detach().cpu().numpy() for v in (axes.origin, axes.rotation[..., 1]))
    return np.stack([origin - half * along, origin + half * along])[:, [2, 1]]


def sensor_curve(system: OpticalSystem, half: float) -> np.ndarray:
    """Return z and y (N, 2), mm, of the sensor's section, up to half a length on both sides.

    It is `sensor_line` of a plane one; a curved one ends where its surface does.
    """
    if system.image is None:
        return sensor_line(system, half)
    y = torch.linspace(-half, half, _CURVE, dtype=torch.float64)
    sag, _, _, exists = system.image.sag_and_slopes(torch.zeros_like(y), y)
    local = torch.stack((torch.zeros_like(y), y, sag), -1)[exists]
    axes = system.global_axes()
    rotation, origin = axes.rotation[-1].detach().cpu(), axes.origin[-1].detach().cpu()
    return (local @ rotation.mT + origin).numpy()[:, [2, 1]]
