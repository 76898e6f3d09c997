"""Moments of spots are functions of the parameters in which many lenses differ."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from dolens.alignment.moments import (
    POWERS,
    Pixels,
    convolved,
    pixel_convolution,
    shift_derivatives,
    sums_and_derivatives,
    weighted_sums,
)
from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError, check_choice
from dolens.optics.lens import Lens
from dolens.optics.lens_family import (
    FamilyRays,
    LensFamily,
    intercept_parts,
    jacobian_parts,
    shared_rays,
    traced_lens,
)
from dolens.optics.ray_tracing import choose_backend
from dolens.optics.rays import Components, Rays, arrives
from dolens.optics.system import require_plane_sensor
from dolens.optimize.image_quality import without_edges

# Numbers that the kernels find at a time stay in the cache, 4 MB, where moments are made of them.
_BY_KERNELS = 1 << 19
# Numbers of a traced ray: position, direction, path length and status.
_OF_A_RAY = 8
# Rays that the reference traces at a time, a derivative counting like a ray: its operations are
# long beside what calling them takes, and intermediate results take 0.4 GB.
_BY_REFERENCE = 1 << 18


@dataclass(frozen=True)
class KernelIntercepts:
    """Traces a family of lenses by the kernels, which give derivatives of every ray.

    A ray that misses a surface or is reflected totally has an intercept that is finite, and means
    nothing.

    Attributes:
        family: of lenses whose apertures clip nothing.
        rays: of a single lens.
    """

    family: LensFamily
    rays: FamilyRays

    def points(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield ray intercepts of lenses with parameters (K, F), some lenses at a time.

        Yields:
            Which lenses; points (k, 2, N), mm; and which lenses lose a ray (k,).
        """
        size = self._lenses_at_a_time(_OF_A_RAY)
        for rows, points, arrive in intercept_parts(self.family, values, self.rays, size):
            yield rows, points.mT, ~arrive.all(-1)

    def derivatives(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield ray intercepts with their derivatives, some lenses at a time; both are zero of a
        ray that is lost.

        Yields:
            Which lenses; points (k, 2, N), mm; and derivatives (k, 2, F, N).
        """
        size = self._lenses_at_a_time(2 * (1 + self.family.count))
        for rows, found in jacobian_parts(self.family, values, self.rays, size):
            yield rows, found.values, found.derivatives

    def _lenses_at_a_time(self, numbers: int) -> int:
        """Return how many lenses have no more than `_BY_KERNELS`, with so many of each ray."""
        return max(1, _BY_KERNELS // (numbers * self.rays.position.shape[1]))


@dataclass(frozen=True)
class ReferenceIntercepts:
    """Traces lenses by the reference tracer under `torch.func.vmap` and forward derivatives.

    Attributes:
        lens: whose apertures clip nothing.
        names: of F parameters.
        rays: N of them.
    """

    lens: Lens
    names: tuple[str, ...]
    rays: Rays

    def points(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield what `KernelIntercepts.points` does."""
        for rows, (points, arrive) in self._batches(self._land, values, 1):
            yield rows, points, ~arrive

    def derivatives(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield what `KernelIntercepts.derivatives` does."""

        def points_twice(row: Tensor) -> tuple[Tensor, Tensor]:
            points, _ = self._land(row)
            return points, points.detach()

        differentiated = jacfwd(points_twice, has_aux=True)
        for rows, found in self._batches(differentiated, values, 1 + len(self.names)):
            derivatives, points = found
            yield rows, points, derivatives.mT

    @torch.no_grad()
    def _batches(
        self, function: Callable[..., tuple[Tensor, Tensor]], values: Tensor, copies: int
    ) -> Iterator[tuple[slice, tuple[Tensor, Tensor]]]:
        """Yield which lenses, and a function of each of them, on one thread.

        Batches cannot have threads of their own: PyTorch counts the levels of forward derivatives
        for the whole process.
        """
        size = max(1, _BY_REFERENCE // (copies * len(self.rays.position)))
        first = 0
        for part in values.split(size):
            with one_thread():
                found = vmap(function)(part)
            yield slice(first, first + len(part)), found
            first += len(part)

    def _land(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (2, N), mm, and whether all rays arrive."""
        hit = traced_lens(self.lens, self.names, values, self.rays)
        return hit.position[:, :2].mT, arrives(hit.status).all()


SpotIntercepts = KernelIntercepts | ReferenceIntercepts


def spot_intercepts(lens: Lens, rays: Rays, names: Sequence[str]) -> SpotIntercepts:
    """Return the ray intercepts of a lens as functions of its parameters.

    The lenses are a `LensFamily`, which the kernels trace by one call; where they do not serve, a
    batch of `torch.func.vmap` over the reference tracer, and the log says so.

    Args:
        lens: in double precision; its `backend` says what traces.
        rays: N of them.
        names: of F parameters, each a single number.

    Raises:
        InputError: no such parameter, or a backend that cannot serve.
    """
    opened = without_edges(lens)
    ray = Components(*(c.double() for c in rays.components()))
    own = Rays.from_components(ray, rays.wavelength)
    if choose_backend(opened.system(), rays) == "reference":
        return ReferenceIntercepts(opened, tuple(names), own)
    wavelengths, shared = shared_rays(own)
    return KernelIntercepts(LensFamily(opened, names, wavelengths), shared)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run many short operations on one thread.

    Split among PyTorch's threads they wait for one another, which takes up to thirty times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


# Where the sensor is, mm: across, where it is from where it should be, and along the axis.
SENSOR = ("sensor_x", "sensor_y", "sensor_distance")


@dataclass(frozen=True)
class MomentModel:
    """Computes moments of S spots from P numbers: some of a lens, and then some of its sensor's.

    Spots are lit by fixed rays of the lens as designed: they do not move in object space, as if
    the entrance pupil stayed where it is, and no aperture clips them.  Points are on the sensor,
    wherever that is: as it moves by +Δ across, light moves by -Δ.

    Attributes:
        names: of the P parameters.
        start: (F,), values as designed of those that rays are traced with, in the lens's units
            (radians for tilts); the sensor's place along the axis is one of them.
        traced: (P, F), which of these each parameter is, one in a row.
        across: (P, 2), which of the sensor's coordinates, likewise; its designed place is zero.
        shares: (N, S), the weight of ray i in spot s; columns sum to one.
        size: (S,), mm, the unit of lengths in moments of each spot.
        centroids: (S, 2), mm, of the spots as designed.
        intercepts: of the rays, as functions of the F numbers.
        pixels: what counts the light; None: every photon is located exactly.
    """

    names: tuple[str, ...]
    start: Tensor
    traced: Tensor
    across: Tensor
    shares: Tensor
    size: Tensor
    centroids: Tensor
    intercepts: SpotIntercepts
    pixels: Pixels | None = None

    @torch.no_grad()
    def points(self, errors: Tensor) -> Tensor:
        """Return the ray intercepts (K, 2, N), mm, with the parameters off by errors (K, P).

        Raises:
            InputError: a ray of such a lens misses a surface or is reflected totally.
        """
        values, across = self._split(errors)
        parts = [
            (points - across[rows, :, None], lost)
            for rows, points, lost in self.intercepts.points(values)
        ]
        found, lost = (torch.cat(part) for part in zip(*parts, strict=True))
        if bool(lost.any()):
            raise InputError(f"misalignments: {int(lost.sum())} of {len(lost)} lenses lose rays")
        return found

    @torch.no_grad()
    def moments(self, errors: Tensor, origin: Tensor) -> Tensor:
        """Return m = Σ w·((x - x₀)/a)ⁱ·((y - y₀)/a)ʲ of each spot, a its size; (i, j) from
        `POWERS`.

        With pixels, x and y are their centres, averaged over the places of the grid.

        Args:
            errors: (K, P), added to the parameters.
            origin: (K, S, 2), mm, (x₀, y₀).

        Returns:
            (K, S, 9).
        """
        values, across = self._split(errors)
        # Points on a displaced sensor about an origin on it: about another one on that as designed.
        about = origin + across[:, None]
        parts = [
            weighted_sums(points, self.shares, about[rows], self.size, POWERS)
            for rows, points, _ in self.intercepts.points(values)
        ]
        return self.convolved(torch.cat(parts))

    @torch.no_grad()
    def moments_and_jacobian(self, errors: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Return the moments (K, S, 9) and their derivatives (K, S, 9, P) with respect to the
        parameters.
        """
        values, across = self._split(errors)
        about = origin + across[:, None]
        parts = [
            sums_and_derivatives(points, derivatives, self.shares, about[rows], self.size)
            for rows, points, derivatives in self.intercepts.derivatives(values)
        ]
        sums, traced = (torch.cat(part) for part in zip(*parts, strict=True))
        # The sensor's place across needs no rays.
        jacobian = traced @ self.traced.mT + shift_derivatives(sums, self.size) @ self.across.mT
        if self.pixels is not None:
            matrix = pixel_convolution(POWERS, self.pixels.pitch / self.size)
            jacobian = matrix[..., :-1] @ jacobian
        return self.convolved(sums), jacobian

    def convolved(self, sums: Tensor) -> Tensor:
        """Return moments (..., S, 9) of what pixels count, from those of the ray intercepts."""
        if self.pixels is None:
            return sums
        return convolved(sums, POWERS, self.pixels.pitch / self.size)

    def _split(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """Return values that are traced (K, F), and the sensor's place across (K, 2)."""
        errors = errors.to(self.start)
        return self.start + errors @ self.traced, errors @ self.across


def moment_model(
    lens: Lens,
    spots: SpotRays,
    names: Sequence[str],
    sensor: Sequence[str] = (),
    pixels: Pixels | None = None,
    size: Tensor | None = None,
) -> MomentModel:
    """Return a lens's spots as functions of some of its parameters.

    Args:
        lens: as designed; its `backend` says what traces, see `spot_intercepts`.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        names: parameters, each a single number.
        sensor: which of the sensor's numbers, from `SENSOR`, are parameters as well.
        pixels: what counts the light; None: every photon is located exactly.
        size: (S,), mm, the unit of lengths in moments; None: each spot's RMS radius as designed.

    Raises:
        InputError: a lens in single precision, rays that stand for mirror images, a parameter
            that the lens lacks, or a number that the sensor lacks.
    """
    if lens.dtype != torch.float64:
        raise InputError(f"lens_dtype: moments of spots need float64, not {lens.dtype}")
    if bool(spots.centred.any()):
        raise InputError("spots: rays of the whole pupil are needed (symmetry=False)")
    for name in sensor:
        check_choice(name, SENSOR, "sensor")
    require_plane_sensor(lens.system(), "moments of spots")
    names = tuple(names)
    along = [name for name in sensor if name not in ("sensor_x", "sensor_y", *names)]
    of_lens = (*names, *along)
    nominal = {name: value.detach() for name, value in lens.variables(of_lens).items()}
    start = torch.stack([nominal[name] for name in of_lens])
    intercepts = spot_intercepts(lens, spots.rays, of_lens)

    shares = spots.weight.new_zeros(len(spots.weight), spots.count)
    shares[torch.arange(len(spots.weight)), spots.spot] = spots.weight
    with torch.no_grad():
        ((_, (points,), _),) = intercepts.points(start[None])
        centroids = (points @ shares).T
        apart = points - centroids.T[:, spots.spot]
        own_size = (apart.square().sum(0) @ shares).sqrt()
    every = (*names, *sensor)
    return MomentModel(
        every,
        start,
        _which(every, of_lens).to(start),
        _which(every, SENSOR[:2]).to(start),
        shares,
        own_size if size is None else size,
        centroids,
        intercepts,
        pixels,
    )


def _which(names: Sequence[str], among: Sequence[str]) -> Tensor:
    """Return a matrix with a one where a name stands among others, a row for each name."""
    return torch.tensor([[float(name == other) for other in among] for name in names])
