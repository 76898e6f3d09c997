"""Spots are sampled by rays through a grid or a Gaussian quadrature of the pupil.

A spot is the light of one field and one wavelength.  Only rays that pass the lens are kept, so that
whoever traces them again and again spends nothing on the others.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.analysis.vignetting import VignettedPupils
from dolens.errors import InputError
from dolens.optics.fields import require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays

# Rings, arms, and points along a side of a grid: more rays than memory holds are no sampling.
_MOST_SIDE = 2000


@dataclass(frozen=True)
class SpotRays:
    """The rays of S spots are stored together; all of them pass the lens.

    Attributes:
        rays: N rays, (N, 3), with wavelengths (N,), spot after spot.
        spot: (N,), int64, from 0 to S - 1.
        weight: (N,), float64, the share of a ray in its spot; they sum to one over each spot.  Of a
            lens with coatings a ray counts by what of its light arrives.
        fields: (S, 2), degrees or mm, float64.
        wavelengths: (S,), nm, float64.
        centred: (S, 2), bool: the spot's mean in x, or in y, is zero by symmetry, because the rays
            stand for their mirror images too; it must not be taken from these rays.
        launched: rays that were tried to find these.
        light: (S,), float64, how much of a spot's beam passes: area over that of the whole stop, as
            the quadrature measures it, or rays over those of the whole grid.
        chief: (S,), int64, which of the rays is the spot's chief ray; they weigh nothing.  None
            where there are none.
    """

    rays: Rays
    spot: Tensor
    weight: Tensor
    fields: Tensor
    wavelengths: Tensor
    centred: Tensor
    launched: int
    light: Tensor
    chief: Tensor | None = None

    @property
    def count(self) -> int:
        """Return the number of spots."""
        return len(self.wavelengths)

    def some(self, chosen: Tensor) -> "SpotRays":
        """Return the spots where `chosen` (S,), bool, is true, with their rays."""
        if bool(chosen.all()):
            return self
        kept = chosen.to(self.spot.device)[self.spot]
        number, place = chosen.cumsum(0).to(self.spot) - 1, kept.cumsum(0) - 1
        rays = self.rays
        waves = torch.as_tensor(rays.wavelength).expand(kept.shape)
        return replace(
            self,
            rays=Rays(rays.position[kept], rays.direction[kept], waves[kept]),
            spot=number[self.spot[kept]],
            weight=self.weight[kept],
            fields=self.fields[chosen],
            wavelengths=self.wavelengths[chosen],
            centred=self.centred[chosen],
            light=self.light[chosen],
            chief=None if self.chief is None else place[self.chief[chosen]],
        )


def square_grid(
    lens: Lens,
    fields: Sequence[Sequence[float]],
    wavelengths: Sequence[float],
    count: int = 31,
    half_width: float | None = None,
) -> SpotRays:
    """Launch parallel rays through a square grid in the plane of the first vertex, equally
    weighted.

    Every wavelength has the rays that pass at its own index.

    Args:
        lens: an object at infinity.
        fields: (x, y), degrees.
        wavelengths: nm.
        count: points along each side.

    Rarely needed:
        half_width: mm; None: the first surface's semi-diameter r₁, plus what its rim's sag moves
            the beam of a field aside, tan(field)·sag(r₁).

    Raises:
        InputError: a spot without rays, or a count or a width that is not positive.
    """
    if count < 1:
        raise InputError(f"count: {count}; allowed: 1 or more rays along each side")
    if count > _MOST_SIDE:
        raise InputError(f"count: {count}; allowed: {_MOST_SIDE} rays along each side at most")
    if half_width is not None and not 0.0 < half_width < math.inf:
        raise InputError(f"half_width: {half_width} mm; allowed: a positive number")
    axis = torch.linspace(-1.0, 1.0, count, dtype=torch.float64)
    unit = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)

    def launch(field: tuple[float, float]) -> Launched:
        require_from_the_front(field, "a grid of rays in the plane of the first vertex")
        tangents = [math.tan(math.radians(angle)) for angle in field]
        tangent = torch.tensor(tangents, dtype=torch.float64)
        width = half_width
        if width is None:
            width = beam_half_width(lens, float(tangent.norm()))
        position = torch.cat([unit * width, torch.zeros_like(unit[:, :1])], 1)
        direction = torch.cat([tangent, torch.ones(1, dtype=torch.float64)])
        direction = (direction / direction.norm()).expand(position.shape)
        return Launched(position, direction, torch.ones(len(unit), dtype=torch.float64), len(unit))

    return _passing(lens, fields, wavelengths, launch)


def beam_half_width(lens: Lens, tangent: float) -> float:
    """Return the half-width (mm), in the plane of the first vertex, of a beam that fills the first
    surface.
    """
    system = lens.system()
    first = system.met[0]
    surface = system.surfaces[first - 1]
    width = surface.semi_diameter + tangent * float(surface.rim_sag(lens.sensor_distance.detach()))
    if not system.breaks:
        return width
    vertex = system.global_axes().origin[first - 1].detach()
    return width + float(vertex[:2].norm()) + tangent * abs(float(vertex[2]))


def gaussian_quadrature(
    lens: Lens,
    fields: Sequence[Sequence[float]],
    wavelengths: Sequence[float],
    rings: int = 6,
    arms: int = 12,
    object_distance: float | None = None,
    symmetry: bool = True,
    lost_light: bool = True,
) -> SpotRays:
    """Sample the vignetted pupil of each field on rings and arms by Gaussian quadrature.

    The means over these rays are those over the light that passes, up to high order: aberrations of
    degree 4·rings - 1 along a radius are integrated exactly where nothing but the stop clips
    (Forbes, J. Opt. Soc. Am. A 5, 1943, 1988).  Where other apertures clip, every arm ends where
    the light does.  In a lens of rotational symmetry a field on the axis needs one arm, and one in
    the y-z plane half of them.

    All wavelengths take the rays aimed at the lens's reference wavelength.

    Args:
        lens: the lens.
        fields: (x, y), degrees or mm, as `Lens.aim` takes them.
        wavelengths: nm.
        rings: radii.
        arms: azimuths of the whole pupil, an even number.
        object_distance: mm in front of the first vertex; None for an object at infinity.

    Rarely needed:
        symmetry: whether a part of the pupil may stand for its mirror images, where the lens has
            the symmetry.
        lost_light: whether rays count by what of their light arrives, of a lens with coatings.

    Raises:
        InputError: a field whose light does not pass, or rings and arms out of range.
    """
    if rings < 1 or arms < 2 or arms % 2:
        raise InputError(f"rings must be at least 1 and arms even, not {rings} and {arms}")
    if rings > _MOST_SIDE or arms > _MOST_SIDE:
        raise InputError(f"rings and arms: {rings} and {arms}; allowed: {_MOST_SIDE} at most")
    radii, shares = gaussian_rings(rings)
    symmetric = symmetry and lens.system().rotationally_symmetric

    distinct = list(dict.fromkeys((float(x), float(y)) for x, y in fields))
    points = torch.tensor(distinct, dtype=torch.float64).reshape(-1, 2)
    azimuths = [_azimuths(field, arms, symmetric) for field in distinct]
    count = max(map(len, azimuths), default=0)
    # Fields with fewer arms repeat theirs, to be traced with the others.
    angles = torch.stack([angle.repeat(-(-count // len(angle)))[:count] for angle in azimuths])
    arm = torch.stack((angles.cos(), angles.sin()), -1)
    pupils = VignettedPupils(lens, points, object_distance)
    centres = pupils.centres((points[:, 0] == 0.0) & symmetric)
    boundary = pupils.boundary_radius(centres, arm)
    along = (radii[:, None] * boundary[:, None])[..., None] * arm[:, None]
    aimed = pupils.aim((centres[:, None, None] + along).flatten(1, 2))
    launched = {}
    for at, (field, angle) in enumerate(zip(distinct, azimuths, strict=True)):
        own = torch.arange(rings * count).reshape(rings, count)[:, : len(angle)].flatten()
        weight = shares[:, None] * boundary[at, : len(angle)].square()
        launched[field] = Launched(
            aimed.position[at, own], aimed.direction[at, own], weight.reshape(-1), len(angle)
        )
    return _passing(lens, fields, wavelengths, launched.__getitem__, symmetric, lost_light)


def gaussian_rings(count: int, rim: bool = False) -> tuple[Tensor, Tensor]:
    """Return radii within the unit circle and the shares of its area that they stand for, (count,)
    each: Gauss and Legendre's nodes in ρ², on which an area's element is even.

    Polynomials in ρ² are exact up to the degree 2·count - 1.  With the rim, they are Radau's
    (Golub, SIAM Rev. 15, 318, 1973), exact up to 2·count - 2.

    Args:
        count: of rings.
        rim: whether the outermost one is the rim itself.
    """
    nodes, weights = _radau(count) if rim else np.polynomial.legendre.leggauss(count)
    return torch.from_numpy(np.sqrt(0.5 * (nodes + 1.0))), torch.from_numpy(0.5 * weights)


def _radau(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes from -1 to 1, the last of them 1, and weights that sum to two."""
    order = np.arange(1, count)
    beside = order / np.sqrt(4.0 * order**2 - 1.0)
    matrix = np.diag(beside, 1) + np.diag(beside, -1)
    matrix[-1, -1] = count / (2.0 * count - 1.0)
    node, vectors = np.linalg.eigh(matrix)
    return node, 2.0 * vectors[0] ** 2


def _azimuths(field: tuple[float, float], arms: int, symmetric: bool) -> Tensor:
    """Return the azimuths (radians) of the arms that stand for the whole pupil."""
    x, y = field
    if symmetric and x == 0.0 and y == 0.0:
        return torch.tensor([0.25 * math.pi], dtype=torch.float64)
    if symmetric and x == 0.0:
        half = arms // 2
        return (torch.arange(half).double() + 0.5) * (math.pi / half) - 0.5 * math.pi
    return (torch.arange(arms).double() + 0.5) * (2.0 * math.pi / arms)


class Launched(NamedTuple):
    """The rays of one field in front of the lens have positions, directions and weights; `whole` is
    the sum of the weights if all of the beam passed.
    """

    position: Tensor
    direction: Tensor
    weight: Tensor
    whole: float


Launch = Callable[[tuple[float, float]], Launched]


@torch.no_grad()
def _passing(
    lens: Lens,
    fields: Sequence[Sequence[float]],
    wavelengths: Sequence[float],
    launch: Launch,
    symmetric: bool = False,
    lost_light: bool = True,
) -> SpotRays:
    """Keep the rays that pass, of every field and wavelength, in the lens's precision."""
    options: dict[str, Any] = {"dtype": lens.dtype, "device": lens.device}
    pieces, launched, light = [], 0, []
    launches: dict[tuple[float, float], Launched] = {}
    spots = product([(float(x), float(y)) for x, y in fields], wavelengths)
    for number, (field, nm) in enumerate(spots):
        if field not in launches:
            launches[field] = launch(field)
        position, direction, weight, whole = launches[field]
        position, direction = position.to(**options), direction.to(**options)
        system = lens.system()
        hit = trace_rays(
            system, Rays(position, direction, nm), transmission=lost_light and system.coated
        )
        valid = hit.valid
        launched += valid.numel()
        if not bool(valid.any()):
            raise InputError(f"no ray of field {field} and {nm:g} nm passes the lens")
        weight = weight.to(valid.device)[valid]
        light.append(float(weight.sum()) / whole)
        if hit.transmission is not None:
            weight = weight * hit.transmission[valid].to(weight)
        pieces.append(
            (
                position[valid],
                direction[valid],
                torch.full((len(weight),), nm, dtype=torch.float64, device=valid.device),
                torch.full((len(weight),), number, device=valid.device),
                weight / weight.sum(),
            )
        )
    position, direction, wavelength, spot, weight = (
        torch.cat(part) for part in zip(*pieces, strict=True)
    )
    points = torch.tensor(
        [(*field, wave) for field, wave in product(fields, wavelengths)], dtype=torch.float64
    )
    on_axis = (points[:, :2] == 0.0).all(-1)
    meridional = points[:, 0] == 0.0
    centred = torch.stack((meridional, on_axis), -1) & symmetric
    return SpotRays(
        Rays(position, direction, wavelength),
        spot,
        weight,
        points[:, :2],
        points[:, 2],
        centred.to(spot.device),
        launched,
        torch.tensor(light, dtype=torch.float64),
    )


@torch.no_grad()
def with_chief_rays(lens: Lens, spots: SpotRays, object_distance: float | None = None) -> SpotRays:
    """Return the spots with their chief rays appended; a chief ray has no weight.

    Raises:
        InputError: a chief ray does not reach the stop.
    """
    chief = lens.chief_ray(spots.fields.to(lens.dtype), lens.primary_wavelength, object_distance)
    if not bool(chief.converged.all()):
        at = int(torch.nonzero(~chief.converged)[0])
        raise InputError(f"the chief ray of field {spots.fields[at].tolist()} misses the stop")
    rays = spots.rays
    count = len(spots.weight)
    device = spots.spot.device
    return replace(
        spots,
        rays=Rays(
            torch.cat([rays.position, chief.position]),
            torch.cat([rays.direction, chief.direction]),
            torch.cat([torch.as_tensor(rays.wavelength), spots.wavelengths.to(device)]),
        ),
        spot=torch.cat([spots.spot, torch.arange(spots.count, device=device)]),
        weight=torch.cat([spots.weight, spots.weight.new_zeros(spots.count)]),
        chief=count + torch.arange(spots.count, device=device),
    )


def joined_spots(parts: Sequence[SpotRays]) -> SpotRays:
    """Return the spots of several sets as one, in their order.

    Args:
        parts: of the same lens; either all have chief rays or none has.
    """
    spots, chiefs, count, rays = [], [], 0, 0
    for part in parts:
        spots.append(part.spot + count)
        if part.chief is not None:
            chiefs.append(part.chief + rays)
        count, rays = count + part.count, rays + len(part.spot)
    return SpotRays(
        rays=Rays(
            torch.cat([part.rays.position for part in parts]),
            torch.cat([part.rays.direction for part in parts]),
            torch.cat([torch.as_tensor(part.rays.wavelength) for part in parts]),
        ),
        spot=torch.cat(spots),
        weight=torch.cat([part.weight for part in parts]),
        fields=torch.cat([part.fields for part in parts]),
        wavelengths=torch.cat([part.wavelengths for part in parts]),
        centred=torch.cat([part.centred for part in parts]),
        launched=sum(part.launched for part in parts),
        light=torch.cat([part.light for part in parts]),
        chief=torch.cat(chiefs) if chiefs else None,
    )


# The rim of the stop, where a ray is still inside although a fit of its start is not exact.
_RIM = 1.0 - 2e-4
_RIM_POINTS = 72
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


def uniform_pupil_points(count: int) -> tuple[Tensor, Tensor]:
    """Return points that cover the unit disc uniformly, and points on its edge.

    A spiral fills the quadrant x, y > 0, and its mirror images the others, so that odd moments are
    exactly zero: ρ² grows evenly and the azimuth by the golden section of the quarter turn (after
    Vogel, Math. Biosciences 44, 179, 1979).  No two points of a quadrant lie on one circle or one
    line, so that an aperture that clips the light takes its share of them, wherever its edge runs;
    points on rings would come and go by whole rings.

    Args:
        count: points that weigh; a multiple of four.

    Returns:
        Points (count + 72, 2) and weights (count + 72,) of sum one.  The last 72 lie on the rim and
        weigh nothing: they are for extents.

    Raises:
        InputError: the number is not positive or no multiple of four.
    """
    if count < 4 or count % 4:
        raise InputError(f"rays must be a positive multiple of four, not {count}")
    index = torch.arange(count // 4, dtype=torch.float64)
    radius = ((index + 0.5) / len(index)).sqrt()
    angle = 0.5 * math.pi * (index * _GOLDEN).frac()
    quadrant = torch.stack((radius * angle.cos(), radius * angle.sin()), -1)
    signs = quadrant.new_tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    inner = (signs[:, None] * quadrant).flatten(0, 1)
    rim = _RIM * circle_points(_RIM_POINTS, 0.0)
    weight = torch.cat([inner.new_full((count,), 1.0 / count), inner.new_zeros(_RIM_POINTS)])
    return torch.cat([inner, rim]), weight


def circle_points(count: int, offset: float) -> Tensor:
    """Return points of the unit circle, (count, 2); the first is `offset` steps from +x."""
    angle = (torch.arange(count, dtype=torch.float64) + offset) * (2.0 * math.pi / count)
    return torch.stack((angle.cos(), angle.sin()), -1)
