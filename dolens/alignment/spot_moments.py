"""Spots in a few numbers each: moments of where light lands, their derivatives, their noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from dolens.errors import InputError
from dolens.imaging.spot_rays import SpotRays
from dolens.optics.lens import Lens
from dolens.optics.rays import Components
from dolens.optics.trace import trace_surfaces, trace_to_plane

# Powers of x and y in the moments of a spot: the centroid, the second and the third moments.
POWERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
MOMENTS = len(POWERS)
# Moments that are linear in the ray points, the first of all.
LINEAR = 2
# Rays traced at a time, a derivative counting like a ray: bounds intermediate results to 0.2 GB.
_RAYS_AT_A_TIME = 1 << 17


@dataclass(frozen=True)
class MomentModel:
    """Moments of S spots as functions of P numbers of a lens.

    Spots are lit by fixed rays of the lens as designed: they do not move in object space, as if
    the entrance pupil stayed where it is, and no aperture clips them.

    Attributes:
        names: of the P parameters.
        start: (P,), their values as designed, in the lens's units (radians for tilts).
        shares: (N, S), the weight of ray i in spot s; columns sum to one.
        size: (S,), mm, RMS radius of each spot as designed: the unit of lengths in moments.
        centroids: (S, 2), mm, of the spots as designed.
        land: (P,) → points (2, N), mm, on the sensor, and the least of what ends a ray, which is
            positive where all rays arrive; to be called in `vmap` and under forward derivatives.
    """

    names: tuple[str, ...]
    start: Tensor
    shares: Tensor
    size: Tensor
    centroids: Tensor
    land: Callable[[Tensor], tuple[Tensor, Tensor]]

    @torch.no_grad()
    def points(self, errors: Tensor) -> Tensor:
        """Where rays land, (K, 2, N), mm, with the parameters off by errors (K, P).

        Raises:
            InputError: a ray of such a lens misses a surface or is reflected totally.
        """
        points, margin = self._in_chunks(vmap(self.land), 1, self.start + errors.to(self.start))
        lost = ~(margin > 0.0)
        if bool(lost.any()):
            raise InputError(f"misalignments: {int(lost.sum())} of {len(lost)} lenses lose rays")
        return points

    @torch.no_grad()
    def moments(self, errors: Tensor, origin: Tensor) -> Tensor:
        """m = Σ w·((x - x₀)/a)ⁱ·((y - y₀)/a)ʲ of each spot, a its size; (i, j) from `POWERS`.

        Args:
            errors: (K, P), added to the parameters.
            origin: (K, S, 2), mm, (x₀, y₀).

        Returns:
            (K, S, 9).
        """
        return self._in_chunks(vmap(self._moments), 1, self.start + errors, origin)[0]

    @torch.no_grad()
    def moments_and_jacobian(self, errors: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """The moments (K, S, 9) and their derivatives by the parameters (K, S, 9, P)."""
        derivative = vmap(jacfwd(self._moments, has_aux=True))
        jacobian, moments = self._in_chunks(
            derivative, 1 + len(self.names), self.start + errors, origin
        )
        return moments, jacobian

    def _moments(self, values: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Twice the same (S, 9): to be differentiated, and to be kept."""
        points, _ = self.land(values)
        found = weighted_sums(points, self.shares, origin, self.size, POWERS)
        return found, found

    def _in_chunks(
        self, batch: Callable[..., tuple[Tensor, ...]], copies: int, *rows: Tensor
    ) -> list[Tensor]:
        """A function of a batch, some rows at a time, on one thread.

        Split among PyTorch's threads, the many short operations wait for one another, which takes
        up to thirty times as long; and chunks cannot have threads of their own, since PyTorch
        counts the levels of forward derivatives for the whole process.
        """
        size = max(1, _RAYS_AT_A_TIME // (copies * len(self.shares)))
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            chunks = zip(*(part.split(size) for part in rows), strict=True)
            parts = [batch(*chunk) for chunk in chunks]
        finally:
            torch.set_num_threads(threads)
        return [torch.cat(part) for part in zip(*parts, strict=True)]


def moment_model(lens: Lens, spots: SpotRays, names: Sequence[str]) -> MomentModel:
    """A lens's spots as functions of some of its parameters, by the reference tracer.

    Args:
        lens: as designed.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        names: parameters, each a single number.

    Raises:
        InputError: a lens in single precision, rays that stand for mirror images, or a parameter
            that the lens lacks.
    """
    if lens.dtype != torch.float64:
        raise InputError(f"lens_dtype: moments of spots need float64, not {lens.dtype}")
    if bool(spots.centred.any()):
        raise InputError("spots: rays of the whole pupil are needed (symmetry=False)")
    nominal = {name: value.detach() for name, value in lens.variables(names).items()}
    names = tuple(names)
    start = torch.stack([nominal[name] for name in names])
    ray = Components(*(c.double() for c in spots.rays.components()))
    wavelength = spots.rays.wavelength

    def land(values: Tensor) -> tuple[Tensor, Tensor]:
        system = lens.system(dict(zip(names, values.unbind(), strict=True)))
        last = trace_surfaces(system, ray, wavelength)
        traced = trace_to_plane(system, last, system.vertices[-1], wavelength, 1.0)
        ends = [m for row in traced.margins for m in (row.met, row.transmitted) if m is not None]
        margin = torch.stack([end.detach().amin() for end in ends]).amin()
        return torch.stack([traced.ray.x, traced.ray.y]), margin

    shares = spots.weight.new_zeros(len(spots.weight), spots.count)
    shares[torch.arange(len(spots.weight)), spots.spot] = spots.weight
    with torch.no_grad():
        points, _ = land(start)
        centroids = (points @ shares).T
        apart = points - centroids.T[:, spots.spot]
        size = (apart.square().sum(0) @ shares).sqrt()
    return MomentModel(names, start, shares, size, centroids, land)


def weighted_sums(
    points: Tensor,
    shares: Tensor,
    origin: Tensor,
    size: Tensor,
    powers: Sequence[tuple[int, int]],
) -> Tensor:
    """Σ w·xⁱ·yʲ of each spot, about an origin and in units of a size.

    Args:
        points: (..., 2, N), mm.
        shares: (N, S), weights w of rays in spots.
        origin: (..., S, 2), mm.
        size: (S,), mm.
        powers: Q pairs (i, j).

    Returns:
        (..., S, Q).
    """
    # Every ray counts in one spot: its origin and its size are picked by that spot.
    own = (shares > 0.0).to(shares)
    unit = (points - origin.mT @ own.mT) / (own @ size)
    highest = max(max(pair) for pair in powers)
    x, y = ([torch.ones_like(unit[..., axis, :])] for axis in (0, 1))
    for _ in range(highest):
        x.append(x[-1] * unit[..., 0, :])
        y.append(y[-1] * unit[..., 1, :])
    return (torch.stack([x[i] * y[j] for i, j in powers], -2) @ shares).mT


@torch.no_grad()
def moment_covariance(
    points: Tensor, shares: Tensor, origin: Tensor, size: Tensor, photons: float
) -> Tensor:
    """Covariance of the moments of spots of so many photons each, exactly.

    A moment about a fixed origin is the mean over photons of f = xⁱ·yʲ, and the photons land
    independently: cov = (E[f·fᵀ] - E[f]·E[f]ᵀ)/photons, from moments up to the sixth.

    Args:
        points: (..., 2, N), mm.
        shares: (N, S).
        origin: (..., S, 2), mm.
        size: (S,), mm.
        photons: of a spot.

    Returns:
        (..., S, 9, 9), in the units of the moments.
    """
    products = [(i + k, j + m) for i, j in POWERS for k, m in POWERS]
    distinct = list(dict.fromkeys((*POWERS, *products)))
    sums = weighted_sums(points, shares, origin, size, distinct)
    places = torch.tensor([distinct.index(pair) for pair in products])
    second = sums[..., places].unflatten(-1, (MOMENTS, MOMENTS))
    mean = sums[..., :MOMENTS]
    return (second - mean[..., :, None] * mean[..., None, :]) / photons


@dataclass(frozen=True)
class MeasuredMoments:
    """Moments of S spots of K lenses as a sensor gave them.

    With (x, y) about another origin every moment is a linear combination of those up to its own
    order, so χ² is the same about any origin; near the spot, rounding is least.

    Attributes:
        origin: (K, S, 2), mm, what moments are about.
        moments: (K, S, 9), in units of the sizes of the spots as designed.
        factor: (K, S, 9, 9), lower triangular L with covariance L·Lᵀ.
    """

    origin: Tensor
    moments: Tensor
    factor: Tensor

    def __getitem__(self, rows: Tensor) -> "MeasuredMoments":
        return MeasuredMoments(self.origin[rows], self.moments[rows], self.factor[rows])


@torch.no_grad()
def simulated_moments(
    model: MomentModel, errors: Tensor, photons: float, generator: torch.Generator | None
) -> MeasuredMoments:
    """What a sensor would measure of lenses with these errors.

    The sums over so many photons are normally distributed about the true moments, by the central
    limit theorem, with all their correlations.  Nothing but photon noise is in them.

    Args:
        model: of all the parameters that are off.
        errors: (K, P), in the lens's units.
        photons: of each spot.
        generator: on the CPU; None: no noise, though the covariance is that of the photons.

    Raises:
        InputError: photons out of range, a lens that loses rays, or so few rays a spot that its
            moments are not independent.
    """
    if not photons >= 1.0:
        raise InputError(f"photons: {photons!r}; allowed: 1 or more")
    points = model.points(errors)
    origin = (points @ model.shares).mT
    covariance = moment_covariance(points, model.shares, origin, model.size, photons)
    factor, failed = torch.linalg.cholesky_ex(covariance)
    spread = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    # A pivot of rounding's size is no independent moment.
    pivots = factor.diagonal(dim1=-2, dim2=-1) / spread.clamp(min=torch.finfo(spread.dtype).tiny)
    if bool((failed > 0).any()) or not bool((pivots > 1e-6).all()):
        raise InputError("rings, arms: too few rays for the moments of a spot to be independent")
    moments = weighted_sums(points, model.shares, origin, model.size, POWERS)
    if generator is not None:
        normal = torch.randn(moments.shape, generator=generator, dtype=moments.dtype)
        moments = moments + (factor @ normal[..., None])[..., 0]
    return MeasuredMoments(origin, moments, factor)
