"""Object points, near and infinitely far, and the light and rays that they send into a lens.

The light that object points send into a lens, relative to a point on the axis.

The points belong to a Lambertian plane perpendicular to the axis, so that what a lens passes of
them falls off as cos⁴ of the field angle where nothing clips the light and the entrance pupil does
not change.

A ray of a given object point is fixed by where it crosses the plane through the first vertex that
faces the point (see `dolens.optics.aiming`).  Tracing costs so little that the part of this
plane whose rays pass is found by trying all that meet the first surface: unlike aiming at the stop,
this asks nothing of the pupil's shape and place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.aiming import launch, line_of_slopes
from dolens.optics.elements import points_to_lens_axes
from dolens.optics.paraxial import entrance_pupil, matrix_to_stop
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status, TracedRays
from dolens.optics.system import OpticalSystem


@dataclass(frozen=True)
class ObjectPoints:
    """N points, each by the line from it to the first vertex and by one over its distance.

    So a point at infinity is like any other, and a far one brings no large number into path
    lengths.

    Attributes:
        slopes: (N, 2), the line from the point to the first vertex has direction
            (slope x, slope y, 1), normalised.
        vergence: (N,), 1/mm, one over the point's distance -z in front of the first vertex; zero
            at infinity.
    """

    slopes: Tensor
    vergence: Tensor

    def __post_init__(self) -> None:
        if self.slopes.ndim != 2 or self.slopes.shape != (*self.vergence.shape, 2):
            raise InputError(
                f"object points need slopes (N, 2) and vergences (N,), not "
                f"{tuple(self.slopes.shape)} and {tuple(self.vergence.shape)}"
            )

    @staticmethod
    def at_infinity(fields: Sequence[Sequence[float]] | Tensor) -> "ObjectPoints":
        """Infinitely far points of fields (N, 2) in degrees.

        Light of field (x, y) travels along (tan x, tan y, 1), as `Lens.aim` takes it.

        Raises:
            InputError: fields that are not pairs, or not between -90° and 90°.
        """
        fields = _pairs(fields, 2, "fields must be pairs (x, y) in degrees, at least one")
        if not bool((fields.detach().abs() < 90.0).all()):
            raise InputError("fields at infinity must lie between -90 and 90 degrees")
        slopes = torch.deg2rad(fields).tan()
        return ObjectPoints(slopes, torch.zeros_like(slopes[:, 0]))

    @staticmethod
    def at(positions: Sequence[Sequence[float]] | Tensor) -> "ObjectPoints":
        """Points (N, 3), mm in the lens's axes; z is negative, -inf only on the axis.

        Raises:
            InputError: positions that are not triples, or not in front of the first vertex.
        """
        positions = _pairs(positions, 3, "object points must be (x, y, z) in mm, at least one")
        z = positions[:, 2]
        if not bool((z.detach() < 0.0).all()):
            raise InputError("object points must lie in front of the first vertex: z < 0")
        return ObjectPoints(positions[:, :2] / z[:, None], -1.0 / z)

    def __len__(self) -> int:
        """N."""
        return len(self.vergence)

    def __getitem__(self, which: Tensor) -> "ObjectPoints":
        """The points that an index or a mask chooses."""
        return ObjectPoints(self.slopes[which], self.vergence[which])

    def to(self, dtype: torch.dtype, device: torch.device) -> "ObjectPoints":
        """The same points in another precision or elsewhere."""
        return ObjectPoints(
            self.slopes.to(device=device, dtype=dtype), self.vergence.to(device=device, dtype=dtype)
        )


def _pairs(values: Sequence[Sequence[float]] | Tensor, count: int, message: str) -> Tensor:
    if not isinstance(values, Tensor) or not values.is_floating_point():
        values = torch.as_tensor(values, dtype=torch.float64)
    if values.ndim != 2 or values.shape[-1] != count or len(values) == 0:
        raise InputError(f"{message}, not {tuple(values.shape)}")
    return values


def flux_density(points: ObjectPoints, q: Tensor, n: Tensor) -> Tensor:
    """Flux per area of the plane through the first vertex that faces the point.

    A point at distance D = 1/w sends cos θ·dΩ into dΩ = D·d²q/(D² + q²)^(3/2).  Times the square of
    the object plane's distance, which makes it finite for a plane at infinity, this is

        c²·n·(1 + w²q²)^(-3/2) d²q,

    with c the cosine between the line to the first vertex and the axis, and n = cos θ the ray's.

    Args:
        points: N of them.
        q: (N, S, S, 2), mm.
        n: (N, S, S), cosine between the rays before the lens and the axis.

    Returns:
        (N, S, S).
    """
    cosine = torch.rsqrt(1.0 + points.slopes.square().sum(-1))
    w = (cosine * points.vergence)[:, None, None]
    spread = 1.0 + w * w * q.square().sum(-1)
    return cosine.square()[:, None, None] * n * spread.pow(-1.5)


def axial_flux(system: OpticalSystem, points: ObjectPoints, wavelength: Tensor) -> Tensor:
    """Flux of the axial point of each point's object plane through the paraxial entrance pupil.

    π·z²·sin²u in units of `flux_density`, with z the object's distance and u the slope of the
    marginal ray there: tan u = r/(A·z + n·B), r the stop's semi-diameter and [[A, B], [C, D]] the
    paraxial matrix to it.

    Args:
        system: the lens.
        points: N of them.
        wavelength: (N,), nm.

    Returns:
        (N,).
    """
    distinct, which = wavelength.unique(return_inverse=True)
    rows = []
    for w in distinct.tolist():
        (a, b), _ = matrix_to_stop(system, w)
        rows.append(torch.stack((a, b * system.signed_indices(w)[0])))
    a, b = torch.stack(rows)[which].unbind(-1)
    near, r = points.vergence, system.surfaces[system.stop - 1].edge_radius
    return torch.pi * r * r / ((a + near * b).square() + (near * r).square())


def path_before(points: ObjectPoints, q: Tensor) -> Tensor:
    """Return a ray's excess length over the line to the first vertex, to the plane that faces it.

    √(D² + q²) - D = q²·w/(1 + √(1 + w²q²)), mm, with D = 1/w the distance to the vertex.

    Args:
        points: N of them.
        q: (N, S, S, 2), mm.

    Returns:
        (N, S, S), zero for points at infinity: to them the plane is a wavefront.
    """
    cosine = torch.rsqrt(1.0 + points.slopes.square().sum(-1))
    w = (cosine * points.vergence)[:, None, None]
    square = q.square().sum(-1)
    return w * square / (1.0 + torch.sqrt(1.0 + w * w * square))


# Rays across the paraxial entrance pupil in the first search, and bounds of their number along each
# side of the first surface.
_ACROSS, _FEWEST, _MOST = 8, 16, 256
# Rays along each side of the beam; the parts that the last spacing before its edge is cut into, and
# how often.
_SIDE, _PARTS, _CUTS = 32, 4, 2
_AZIMUTHS, _RADII = 32, 8


@dataclass(frozen=True)
class EntranceBeam:
    """The light of N object points and wavelengths where it enters a lens; no gradient.

    Attributes:
        centre: (N, 2), mm, of a box that holds the beam, in the plane through the first vertex that
            faces the point; its axes are those of `launch`.
        half_width: (N, 2), mm.
        apertures: numbers of the surfaces whose apertures bound any of the beams.
        ended: (N,), bool: part of the edge is made by rays that miss a surface or are totally
            reflected, rather than by apertures.
        lit: (N,), bool: whether any light passes.
    """

    centre: Tensor
    half_width: Tensor
    apertures: tuple[int, ...]
    ended: Tensor
    lit: Tensor


@torch.no_grad()
def find_beam(system: OpticalSystem, points: ObjectPoints, wavelength: Tensor) -> EntranceBeam:
    """Search the plane before the lens for the light that passes it.

    Args:
        system: the lens, in double precision.
        points: N object points.
        wavelength: (N,), nm, of each.

    Returns:
        Beams; those of points whose light does not pass are not `lit`, and cover the first surface.
    """
    centre, half_width = _first_surface(system, points)
    search = _PupilSearch(system, points, wavelength)
    side = _first_side(system, float(wavelength[0]), float(half_width.max()))
    q = box_grid(centre, half_width, side)
    valid = search.passing(q)
    if side < _MOST and not bool(valid.flatten(1).any(-1).all()):
        # A sliver of light may have slipped through.
        q = box_grid(centre, half_width, _MOST)
        valid = search.passing(q)
    lit = valid.flatten(1).any(-1)
    box = _box(q, valid, centre, half_width)
    q = box_grid(*box, _SIDE)
    edge = search.edge(q, search.passing(q))
    apertures, ended = search.stops(edge)
    low, high = _extremes(edge.outside, edge.owner, len(points))
    # Between the lines of the grid the edge may reach further, by less than their distance.
    reach = 0.5 * (high - low) + (2.0 / _SIDE) * box[1]
    there = (lit & (low <= high).all(-1))[:, None]
    return EntranceBeam(
        torch.where(there, 0.5 * (low + high), centre),
        torch.where(there, reach, half_width),
        apertures,
        ended,
        lit,
    )


def box_grid(centre: Tensor, half_width: Tensor, side: int, rim: int = 0) -> Tensor:
    """Centres of side × side cells of boxes (N, 2), and of `rim` more cells around: (N, S, S, 2).

    The second of the two dimensions S counts x, the first y.
    """
    step = torch.arange(-rim, side + rim, dtype=centre.dtype, device=centre.device)
    unit = (2.0 * step + 1.0) / side - 1.0
    y, x = torch.meshgrid(unit, unit, indexing="ij")
    return centre[:, None, None] + half_width[:, None, None] * torch.stack((x, y), -1)


def launched(points: ObjectPoints, q: Tensor) -> Components:
    """Rays (N, S, S) of N points through points (N, S, S, 2), mm, of the planes that face them."""
    line = line_of_slopes(points.slopes)
    return launch(line[:, None, None], points.vergence[:, None, None], q)


class _Edge(NamedTuple):
    """M points (M, 2), mm, either side of beams' edges, and whose beam each belongs to, (M,)."""

    inside: Tensor
    outside: Tensor
    owner: Tensor


@dataclass(frozen=True)
class _PupilSearch:
    system: OpticalSystem
    points: ObjectPoints
    wavelength: Tensor

    def passing(self, q: Tensor) -> Tensor:
        """(N, S, S), bool: which rays through points (N, S, S, 2) pass the lens."""
        return self._pass(launched(self.points, q), self.wavelength[:, None, None])

    def edge(self, q: Tensor, valid: Tensor) -> _Edge:
        """The edge between rays of a grid that pass and their neighbours that do not."""
        inside, outside, owner = [], [], []
        for dim in (1, 2):
            size = valid.shape[dim] - 1
            here, there = valid.narrow(dim, 0, size), valid.narrow(dim, 1, size)
            crossed = here != there
            first, second = q.narrow(dim, 0, size)[crossed], q.narrow(dim, 1, size)[crossed]
            passes = here[crossed][:, None]
            inside.append(torch.where(passes, first, second))
            outside.append(torch.where(passes, second, first))
            owner.append(torch.nonzero(crossed)[:, 0])
        edge = _Edge(torch.cat(inside), torch.cat(outside), torch.cat(owner))
        part = torch.arange(1, _PARTS, dtype=q.dtype, device=q.device) / _PARTS
        for _ in range(_CUTS):
            tried = torch.lerp(edge.inside, edge.outside, part[:, None, None])
            every = edge.owner.expand(tried.shape[:-1])
            passes = self._pass(self._rays(tried, every), self.wavelength[every])
            # The last point before the first whose ray does not pass.
            last = passes.long().cumprod(0).sum(0)[None, :, None].expand(1, -1, 2)
            ladder = torch.cat([edge.inside[None], tried, edge.outside[None]])
            edge = _Edge(ladder.gather(0, last)[0], ladder.gather(0, last + 1)[0], edge.owner)
        return edge

    def stops(self, edge: _Edge) -> tuple[tuple[int, ...], Tensor]:
        """Return what stops the rays just outside: apertures, and (N,), bool, anything else.

        They are so near the edge that only what makes it stops them.
        """
        hit = self._trace(self._rays(edge.outside, edge.owner), self.wavelength[edge.owner])
        clipped = hit.status == Status.VIGNETTED
        owners = torch.zeros(len(self.points), dtype=torch.bool, device=clipped.device)
        ended = owners.index_fill(0, edge.owner[~clipped], True)
        return tuple(hit.surface[clipped].unique().tolist()), ended

    def _rays(self, q: Tensor, owner: Tensor) -> Components:
        line = line_of_slopes(self.points.slopes)
        return launch(line[owner], self.points.vergence[owner], q)

    def _pass(self, ray: Components, wavelength: Tensor) -> Tensor:
        return self._trace(ray, wavelength).valid

    def _trace(self, ray: Components, wavelength: Tensor) -> TracedRays:
        rays = Rays.from_components(ray, wavelength)
        return trace_rays(self.system, rays)


def _box(q: Tensor, valid: Tensor, centre: Tensor, half_width: Tensor) -> tuple[Tensor, Tensor]:
    """Centres and half-widths (N, 2) of boxes about the points of grids whose rays pass.

    They reach as far as the next points; where none passes, they are as they were.
    """
    step = 2.0 * half_width / valid.shape[-1]
    there = valid[..., None]
    low = torch.where(there, q, math.inf).flatten(1, 2).amin(1) - step
    high = torch.where(there, q, -math.inf).flatten(1, 2).amax(1) + step
    lit = (low <= high).all(-1, keepdim=True)
    return (
        torch.where(lit, 0.5 * (low + high), centre),
        torch.where(lit, 0.5 * (high - low), half_width),
    )


def _extremes(q: Tensor, owner: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates (N, 2) of each owner's points (M, 2)."""
    start = q.new_full((count, 2), math.inf)
    index = owner[:, None].expand(q.shape)
    return (
        start.scatter_reduce(0, index, q, "amin"),
        (-start).scatter_reduce(0, index, q, "amax"),
    )


def _first_side(system: OpticalSystem, wavelength: float, half_width: float) -> int:
    """Rays along each side that do not step over the entrance pupil."""
    diameter = abs(float(entrance_pupil(system, wavelength).diameter))
    if not 0.0 < diameter < math.inf:
        return _MOST
    return min(max(math.ceil(2.0 * half_width / diameter * _ACROSS), _FEWEST), _MOST)


def _first_surface(system: OpticalSystem, points: ObjectPoints) -> tuple[Tensor, Tensor]:
    """Boxes (N, 2) about all rays that meet the first surface within its aperture."""
    first = system.met[0]
    surface, axes = system.surfaces[first - 1], system.axes[first - 1]
    like = system.sensor_distance.detach()
    options: dict[str, Any] = {"dtype": like.dtype, "device": like.device}
    azimuth = torch.arange(_AZIMUTHS, **options) * (2.0 * math.pi / _AZIMUTHS)
    # A dome seen from the side has its outline inside the rim.
    radius = torch.arange(1, _RADII + 1, **options)[:, None] * (surface.semi_diameter / _RADII)
    # The polygon of the azimuths lies inside the circle.
    radius = radius / math.cos(math.pi / _AZIMUTHS)
    x, y = (radius * azimuth.cos()).flatten(), (radius * azimuth.sin()).flatten()
    sag = surface.shape.sag_and_gradient(surface.parameters, x, y)[0]
    position = torch.stack(points_to_lens_axes((x, y, sag), axes), -1)

    line = torch.nn.functional.pad(points.slopes, (0, 1), value=1.0)
    line = line / line.norm(dim=-1, keepdim=True)
    # From the object point, at distance 1/w before the vertex, onto the plane that faces it.
    depth = line @ position.T
    w = (line[:, 2] * points.vergence)[:, None]
    onto = position - depth[..., None] * line[:, None]
    onto = onto / (1.0 + w * depth).clamp(min=1e-3)[..., None]
    # In the axes of that plane: the inverse of `launch`.
    tilt = line[:, None, :2] / (1.0 + line[:, None, 2:])
    q = onto[..., :2] - tilt * onto[..., 2:]
    low, high = q.amin(1), q.amax(1)
    return 0.5 * (low + high), 0.5 * (high - low)
