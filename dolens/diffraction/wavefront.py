"""The wavefront in the exit pupil: exact paths to a sphere about a point of the sensor, and the
share of each grid cell that light passes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.entrance_beam import (
    EntranceBeam,
    ObjectPoints,
    axial_flux,
    box_grid,
    find_beam,
    flux_density,
    launched,
    path_before,
)
from dolens.diffraction.reference_sphere import (
    chief_ray_intercepts,
    on_tangent_planes,
    sphere_curvature,
    to_sphere,
)
from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes
from dolens.optics.paraxial_rays import with_vergences
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Unlimited
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem

# Smallest slope along one axis of a grid over that along the other: an edge along the grid.
_ALONG = 1e-3


def coverage(aperture: ClearAperture, x: Tensor, y: Tensor, radius: Tensor | None = None) -> Tensor:
    """The share of every cell of a grid that an aperture passes.

    Args:
        aperture: of a surface.
        x: (..., S, S), mm, where the ray of the cell's centre crosses the surface, in its axes.
        y: (..., S, S), mm.
        radius: of the edge, a circle, mm, where a gradient with respect to it is wanted.

    Returns:
        (..., S, S), from 0 to 1; its derivative with respect to x, y and the radius is that
        of the area, as far as an edge is straight across a cell.
    """
    share = torch.ones_like(x)
    u, v = x - aperture.center[0], y - aperture.center[1]
    edge = aperture.edge
    if isinstance(edge, Circle) and radius is not None:
        # A circle's margin is r² - ρ².
        squared = radius.to(x).square()
        share = covered(edge.margin(x, y) + (squared - squared.detach()))
    elif not isinstance(edge, Unlimited):
        share = edge.share(covered, *((x, y) if edge.rotational else (u, v)))
    if aperture.window is not None:
        share = torch.minimum(share, aperture.window.share(covered, u, v))
    if aperture.obscuration is not None:
        # In cells of two edges, as where the arms of a spider end, these cross.
        share = share * (1.0 - aperture.obscuration.share(covered, u, v))
    return share


def covered(margin: Tensor) -> Tensor:
    """The share of every cell where a function given at the centres of a grid is positive.

    Within a cell the function is taken as linear, m + a·u + b·v with |u|, |v| ≤ 1/2, and m as its
    mean over the cell, so that the area inside a bent edge is right to higher order.  With
    R(t) = max(t, 0)²/2 the share is

        (R(m + (a + b)/2) - R(m + (a - b)/2) - R(m - (a - b)/2) + R(m - (a + b)/2)) / (a·b).

    Args:
        margin: (..., S, S).

    Returns:
        (..., S, S), from 0 to 1.
    """
    positive = margin.detach() > 0.0
    share = positive.to(margin.dtype)
    # All but a few cells lie on one side of the edge with all of their neighbours.
    edge = torch.nonzero(_beside_others(positive).flatten()).flatten()
    if len(edge) == 0:
        return share
    height, width = margin.shape[-2:]
    row, column = edge // width % height, edge % width
    m, flat = margin.flatten()[edge], margin.flatten()
    slopes = []
    mean = m
    for at, size, stride in ((column, width, 1), (row, height, width)):
        back, ahead = (at > 0).long(), (at < size - 1).long()
        before, behind = flat[edge - stride * back], flat[edge + stride * ahead]
        slopes.append(((behind - before) / (back + ahead)).abs())
        mean = mean + torch.where(back + ahead == 2, before + behind - 2.0 * m, 0.0) / 24.0
    a, b = slopes
    # Products of two of them do not vanish in the precision.
    tiny = torch.finfo(m.dtype).tiny ** 0.25
    steepest = torch.maximum(a, b).detach().clamp(min=tiny)
    a, b = torch.maximum(a, _ALONG * steepest), torch.maximum(b, _ALONG * steepest)
    wide, narrow = 0.5 * (a + b), 0.5 * (a - b)
    # Far from the edge the squares would cancel where they must not.
    mean = torch.minimum(torch.maximum(mean, -wide), wide)
    corners = _ramp(mean + wide) - _ramp(mean + narrow) - _ramp(mean - narrow) + _ramp(mean - wide)
    passed = (corners / (a * b)).clamp(0.0, 1.0)
    return share.flatten().index_copy(0, edge, passed).reshape(margin.shape)


def _ramp(t: Tensor) -> Tensor:
    return 0.5 * t.clamp(min=0.0).square()


def _beside_others(mask: Tensor) -> Tensor:
    """Return where a mask (..., S, S) may differ between a cell and any of its eight neighbours."""
    found = torch.zeros_like(mask)
    for dim in (-1, -2):
        # Beyond the grid nothing is known.
        found.select(dim, 0).fill_(True)
        found.select(dim, -1).fill_(True)
        size = mask.shape[dim] - 1
        differ = mask.narrow(dim, 0, size) != mask.narrow(dim, 1, size)
        found.narrow(dim, 0, size).logical_or_(differ)
        found.narrow(dim, 1, size).logical_or_(differ)
    grown = found.clone()
    for dim in (-1, -2):
        size = mask.shape[dim] - 1
        grown.narrow(dim, 0, size).logical_or_(found.narrow(dim, 1, size))
        grown.narrow(dim, 1, size).logical_or_(found.narrow(dim, 0, size))
    return grown


MM_PER_NM = 1e-6
# Rays around the box, for differences of fourth order.
RIM = 2
_FEWEST = 8
_SMALLEST = 1e-30


@dataclass(frozen=True)
class Wavefront:
    """Wavefronts of N object points and wavelengths, by S × S rays each; double precision.

    The rays are regular where they enter the lens: cells of equal area of the plane through the
    first vertex that faces the point.  Of the two dimensions S the second runs along +x there.

    The phase of the light on the reference sphere is exp(+2πi·OPD/λ), time going as exp(-iωt).

    Attributes:
        opd: (N, S, S), mm: optical path to the reference sphere less its mean over the pupil.
            Positive where light arrives late; Welford's W has the other sign.
        direction: (N, S, S, 2), x and y of the unit vector from the ray's point of the sphere
            towards its centre.
        intercept: (N, S, S, 2), mm, where the rays meet the sensor, from the sphere's centre; of a
            curved sensor the plane that touches it there, whose axes `direction` has too.
        area: (N, S, S), of the ray's cell, in direction cosines.
        amplitude: (N, S, S), root of the flux per area in direction cosines: amplitude²·area is the
            flux of a whole cell over that of the axial point of the same object plane through the
            paraxial entrance pupil (see `dolens.diffraction.entrance_beam`), less what a lens with
            coatings loses.
        coverage: (N, S, S), from 0 to 1: the share of the cell that all apertures pass.
        valid: (N, S, S), bool: the ray reaches the sensor, clipped or not, and so do its
            neighbours.  The others have finite numbers, no coverage and no gradient.
        crossings: number of a surface whose aperture bounds a pupil → (N, S, S, 2), mm, where the
            rays cross it, in its axes.
        clipping: number → that surface.
        ended: (N,), bool: part of the pupil's edge is made by rays that miss a surface or are
            totally reflected; coverage is 0 or 1 there.
        centre: (N, 2), mm on the sensor, of the reference sphere.
        curvature: (N,), 1/mm, of the reference sphere.
        wavelength: (N,), nm.
        index: (N,), before the sensor.
        landed: (N, S, S, 2), mm, x and y where the rays meet the sensor.
        passed: (N, S, S), the share of unpolarised light that arrives; None: of a lens without
            coatings.
    """

    opd: Tensor
    direction: Tensor
    intercept: Tensor
    area: Tensor
    amplitude: Tensor
    coverage: Tensor
    valid: Tensor
    crossings: Mapping[int, Tensor]
    clipping: Mapping[int, SurfaceState]
    ended: Tensor
    centre: Tensor
    curvature: Tensor
    wavelength: Tensor
    index: Tensor
    landed: Tensor
    passed: Tensor | None = None

    @property
    def waves(self) -> Tensor:
        """(N, S, S), the OPD in wavelengths."""
        return self.opd / (MM_PER_NM * self.wavelength[:, None, None])

    @property
    def weight(self) -> Tensor:
        """(N, S, S), amplitude·area·coverage: a ray's share in sums over the pupil function."""
        return self.amplitude * self.area * self.coverage

    @property
    def flux(self) -> Tensor:
        """(N,), what passes of a point's light, over an axial one's; see `amplitude`."""
        return (self.amplitude * self.weight).sum((-2, -1))

    @property
    def rms(self) -> Tensor:
        """(N,), mm, root mean square of the OPD, weighted by amplitude; NaN without light."""
        square = (_share(self.weight) * self.opd.square()).sum((-2, -1))
        # A root of nothing would send NaN backwards, to the lens and so to all points.
        return self._with_light(torch.where(self.flux > 0.0, square, 1.0).sqrt())

    @property
    def strehl_ratio(self) -> Tensor:
        """(N,), |∫A·exp(ik·OPD)|²/(∫A)²: irradiance at the sphere's centre over the unaberrated.

        For small aberrations it is exp(-(k·σ)²), σ the `rms` (Maréchal).  NaN without light.
        """
        phase, share = (2.0 * torch.pi) * self.waves, _share(self.weight)
        real, imaginary = (share * phase.cos()).sum((-2, -1)), (share * phase.sin()).sum((-2, -1))
        return self._with_light(real.square() + imaginary.square())

    def _with_light(self, value: Tensor) -> Tensor:
        return torch.where(self.flux > 0.0, value, math.nan)


def pupil_wavefront(
    system: OpticalSystem,
    points: ObjectPoints,
    wavelength: float | Sequence[float] | Tensor,
    centres: Sequence[Sequence[float]] | Tensor | None = None,
    samples: int = 32,
    radius: float | Tensor | None = None,
    beam: EntranceBeam | None = None,
    on_sensor: bool = False,
) -> Wavefront:
    """Trace the wavefronts of object points to reference spheres about points of the sensor.

    Paths start on a wavefront through the first vertex, so that an object's distance enters no
    number; all is in double precision.

    Args:
        system: `lens.system(values)`, of any precision.
        points: N of them.
        wavelength: nm, one or N.
        centres: (N, 2), mm on the sensor; None: where the chief rays land.
        samples: S, rays along each side of a box about the beam; the outermost lie outside of it.

    Rarely needed:
        radius: mm, of the reference spheres, one or N; infinite ones are planes far away.  None: to
            the paraxial exit pupil at the first wavelength (see `sphere_curvature`).
        beam: of the same points through this lens; None: it is searched.
        on_sensor: paths end on the plane of the sensor, in the place of a sphere: `direction` is
            then where rays meet it, mm from `centre`, `area` in mm², and amplitude² flux per mm².

    Returns:
        Wavefronts, differentiable in the lens; the spheres are held constant.  A point whose light
        does not pass has no coverage.

    Raises:
        InputError: numbers of points, wavelengths, centres and radii that do not fit, fewer than 8
            samples, or a sphere that cannot be placed.
    """
    if samples < _FEWEST:
        raise InputError(f"a wavefront needs at least {_FEWEST} samples a side, not {samples}")
    system = system.double()
    options: dict[str, Any] = {"dtype": torch.float64, "device": system.device}
    points = points.to(**options)
    waves = _one_each("wavelengths", wavelength, len(points), options)
    near = points.vergence
    alike = bool((near == near[0]).all())
    system = with_vergences(system, float(waves[0]), near[0] if alike else near[:, None, None])
    if beam is None:
        beam = find_beam(system, points, waves)
    if centres is None:
        centre = chief_ray_intercepts(system, points, waves)
    else:
        centre = torch.as_tensor(centres, **options).detach()
        if centre.shape != (len(points), 2):
            raise InputError(f"centres must be ({len(points)}, 2) in mm, not {tuple(centre.shape)}")
    if radius is not None:
        radius = _one_each("radii", radius, len(points), options)
    curvature = (
        torch.zeros_like(waves)
        if on_sensor
        else sphere_curvature(system, centre, float(waves[0]), radius)
    )

    # A cell around the beam, so that its edge lies inside the grid.
    half_width = beam.half_width * (samples / (samples - 2.0))
    q = box_grid(beam.centre, half_width, samples, RIM)
    ray, every, opened = launched(points, q), waves[:, None, None], system.opened()
    rays = Rays.from_components(ray, every)
    hit = trace_rays(opened, rays, transmission=opened.coated)
    away, arriving = hit.position[..., :2] - centre[:, None, None], hit.direction
    path: Tensor | float = 0.0
    if system.image is not None:
        away, arriving, path = on_tangent_planes(system, hit, centre)
    excess, direction, meets = to_sphere(away, arriving, curvature[:, None, None])
    excess = excess - path
    if on_sensor:
        excess, direction = torch.zeros_like(excess), away
    valid = _with_neighbours(hit.valid & meets)
    index = system.materials[-1].index(waves) * torch.ones_like(waves)
    start = system.materials[0].index(every) * path_before(points, q)
    opd = _inner(start + hit.path_length - index[:, None, None] * excess)

    # Light that is parallel at an infinite sphere has no area there.
    area = torch.where(valid, cell_areas(direction).clamp(min=_SMALLEST), 1.0)
    cell = (2.0 / samples) ** 2 * half_width.prod(-1) / axial_flux(system, points, waves)
    density = flux_density(points, _inner(q), _inner(ray.n)) * cell[:, None, None] / area
    passed = None if hit.transmission is None else _inner(hit.transmission)
    if passed is not None:
        density = density * passed
    amplitude = torch.where(valid & (density > 0.0), density, 1.0).sqrt()

    inside = Rays(_inner(rays.position), _inner(rays.direction), every)
    crossings, share = {}, (valid & beam.lit[:, None, None]).to(opd.dtype)
    for number in beam.apertures:
        x, y = _crossing(opened, inside, number)
        crossings[number] = torch.stack((x, y), -1)
        surface = system.surfaces[number - 1]
        share = torch.minimum(share, coverage(surface.aperture, x, y, surface.edge))
    piston = (_share((amplitude * area * share).detach()) * opd).sum((-2, -1))
    return Wavefront(
        opd=torch.where(valid, opd - piston[:, None, None], 0.0),
        direction=_inner(direction),
        intercept=_inner(away),
        area=area,
        amplitude=torch.where(valid, amplitude, 0.0),
        coverage=share,
        valid=valid,
        crossings=crossings,
        clipping={number: system.surfaces[number - 1] for number in crossings},
        ended=beam.ended,
        centre=centre,
        curvature=curvature,
        wavelength=waves,
        index=index,
        landed=_inner(hit.position[..., :2]),
        passed=passed,
    )


def _crossing(system: OpticalSystem, rays: Rays, number: int) -> tuple[Tensor, Tensor]:
    """Return the intercepts of rays with a surface, x and y in its axes, mm."""
    hit = trace_rays(system, rays, last=number)
    there = from_lens_axes(hit.components(), system.axes[number - 1])
    return there.x, there.y


def cell_areas(direction: Tensor) -> Tensor:
    """Return |∂(x, y)/∂(row, column)| (N, S, S) by central differences of fourth order.

    Args:
        direction: (N, S + 4, S + 4, 2), x and y at the centres of cells, two more on every side.
    """
    up, along = _slope(direction, 1), _slope(direction, 2)
    return (along[..., 0] * up[..., 1] - along[..., 1] * up[..., 0]).abs()


def _slope(values: Tensor, dim: int) -> Tensor:
    """(N, S, S, 2), per cell, of (N, S + 4, S + 4, 2)."""
    other = 3 - dim
    values = values.narrow(other, RIM, values.shape[other] - 2 * RIM)
    size = values.shape[dim] - 2 * RIM
    far_before, before, behind, far_behind = (values.narrow(dim, at, size) for at in (0, 1, 3, 4))
    return (8.0 * (behind - before) - (far_behind - far_before)) / 12.0


def _with_neighbours(valid: Tensor) -> Tensor:
    """(N, S, S), bool: where all rays are valid that the differences take."""
    size = valid.shape[1] - 2 * RIM
    kept = torch.ones_like(_inner(valid))
    for at in range(2 * RIM + 1):
        kept = kept & valid[:, at : at + size, RIM:-RIM] & valid[:, RIM:-RIM, at : at + size]
    return kept


def _inner(values: Tensor) -> Tensor:
    return values[:, RIM:-RIM, RIM:-RIM]


def _share(weight: Tensor) -> Tensor:
    """Return each ray's share of all that passes; zero where nothing does."""
    whole = weight.sum((-2, -1), keepdim=True)
    return weight / torch.where(whole > 0.0, whole, 1.0)


def _one_each(
    what: str,
    values: float | Sequence[float] | Tensor,
    count: int,
    options: Mapping[str, Any],
) -> Tensor:
    tensor = torch.as_tensor(values, **options).detach()
    if tensor.ndim > 1 or (tensor.ndim == 1 and len(tensor) not in (1, count)):
        raise InputError(f"{what} must be one or {count} numbers, not {tuple(tensor.shape)}")
    return tensor.expand(count)
