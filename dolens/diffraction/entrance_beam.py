"""The rays of an object point that pass a lens, as seen from its front.

A ray of a given object point is fixed by where it crosses the plane through the first vertex that
faces the point (see `dolens.optics.launching`).  Tracing costs so little that the part of this
plane whose rays pass is found by trying all that meet the first surface: unlike aiming at the stop,
this asks nothing of the pupil's shape and place.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.diffraction.object_points import ObjectPoints
from dolens.optics.elements import to_lens_axes
from dolens.optics.launching import launch, line_of_slopes
from dolens.optics.paraxial import entrance_pupil
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status, TracedRays
from dolens.optics.system import OpticalSystem

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
    zero = torch.zeros_like(x)
    there = to_lens_axes(Components(x, y, sag, zero, zero, zero + 1.0), axes)
    position = torch.stack(there[:3], -1)

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
