"""Moments describe the spots of a lens in a few numbers each, with their derivatives."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd, jvp, vmap

from dolens.alignment.moments import POWERS, shift_derivatives, weighted_sums
from dolens.alignment.pixel_moments import Pixels, convolved, pixel_convolution
from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError, check_choice
from dolens.optics.lens import Lens
from dolens.optics.rays import Components
from dolens.optics.straight import require_plane_sensor
from dolens.optics.trace import trace_surfaces, trace_to_sensor

# Where the sensor is, mm: across, where it is from where it should be, and along the axis.
SENSOR = ("sensor_x", "sensor_y", "sensor_distance")
# Rays traced at a time, a derivative counting like a ray: bounds intermediate results to 0.4 GB,
# and makes operations long beside what calling them takes.
_RAYS_AT_A_TIME = 1 << 18


@dataclass(frozen=True)
class MomentModel:
    """Computes moments of S spots from P numbers: T of a lens, and then some of its sensor's.

    Spots are lit by fixed rays of the lens as designed: they do not move in object space, as if
    the entrance pupil stayed where it is, and no aperture clips them.  Points are on the sensor,
    wherever that is: as it moves by +Δ, light moves by -Δ.

    Attributes:
        names: of the P parameters.
        start: (T,), values as designed of those that are traced, in the lens's units (radians for
            tilts); numbers of the sensor start from zero.
        sensor: (P - T, 3), which of `SENSOR` the others are, one in each row.
        shares: (N, S), the weight of ray i in spot s; columns sum to one.
        size: (S,), mm, the unit of lengths in moments of each spot.
        centroids: (S, 2), mm, of the spots as designed.
        land: (T,) → points (2, N), mm, on the sensor as designed, slopes (2, N) there, dx/dz and
            dy/dz, and the least of what ends a ray, which is positive where all rays arrive; to be
            called in `vmap` and under forward derivatives.
        pixels: what counts the light; None: every photon is located exactly.
    """

    names: tuple[str, ...]
    start: Tensor
    sensor: Tensor
    shares: Tensor
    size: Tensor
    centroids: Tensor
    land: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
    pixels: Pixels | None = None

    @torch.no_grad()
    def points(self, errors: Tensor) -> Tensor:
        """Return the ray intercepts (K, 2, N), mm, with the parameters off by errors (K, P).

        Raises:
            InputError: a ray of such a lens misses a surface or is reflected totally.
        """
        points, _, margin = self._in_chunks(vmap(self._arrive), 1, *self._split(errors))
        lost = ~(margin > 0.0)
        if bool(lost.any()):
            raise InputError(f"misalignments: {int(lost.sum())} of {len(lost)} lenses lose rays")
        return points

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
        sums = vmap(lambda *row: self._sums(*row)[1][:1])
        return self.convolved(self._in_chunks(sums, 1, *self._split(errors), origin)[0])

    @torch.no_grad()
    def moments_and_jacobian(self, errors: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Return the moments (K, S, 9) and their derivatives (K, S, 9, P) with respect to the
        parameters.
        """
        copies = 1 + len(self.start)
        sums, jacobian = self._in_chunks(
            vmap(self._derivatives), copies, *self._split(errors), origin
        )
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
        """Return values that are traced (K, T), and the sensor's place (K, 3)."""
        traced, other = errors.to(self.start).split([len(self.start), len(self.sensor)], 1)
        return self.start + traced, other @ self.sensor

    def _arrive(self, values: Tensor, sensor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `land` does, on the sensor at its place (3,)."""
        points, slopes, margin = self.land(values)
        return points + sensor[2] * slopes - sensor[:2, None], slopes, margin

    def _sums(
        self, values: Tensor, sensor: Tensor, origin: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Return moments (S, 9), to be differentiated; and the same, points, and slopes, to be
        kept.
        """
        points, slopes, _ = self._arrive(values, sensor)
        found = weighted_sums(points, self.shares, origin, self.size, POWERS)
        return found, (found, points.detach(), slopes.detach())

    def _derivatives(self, values: Tensor, sensor: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Return moments (S, 9), and derivatives (S, 9, P): only those of the lens need its
        rays.
        """
        traced, (found, points, slopes) = jacfwd(self._sums, has_aux=True)(values, sensor, origin)
        if not len(self.sensor):
            return found, traced

        def on_sensor(at: Tensor) -> Tensor:
            return weighted_sums(at, self.shares, origin, self.size, POWERS)

        along = jvp(on_sensor, (points,), (slopes,))[1]
        other = torch.cat([shift_derivatives(found, self.size), along[..., None]], -1)
        return found, torch.cat([traced, other @ self.sensor.mT], -1)

    def _in_chunks(
        self, batch: Callable[..., tuple[Tensor, ...]], copies: int, *rows: Tensor
    ) -> list[Tensor]:
        """Return a function of a batch, computed some rows at a time, on one thread.

        Chunks cannot have threads of their own: PyTorch counts the levels of forward derivatives
        for the whole process.
        """
        size = max(1, _RAYS_AT_A_TIME // (copies * len(self.shares)))
        with one_thread():
            chunks = zip(*(part.split(size) for part in rows), strict=True)
            parts = [batch(*chunk) for chunk in chunks]
        return [torch.cat(part) for part in zip(*parts, strict=True)]


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


def moment_model(
    lens: Lens,
    spots: SpotRays,
    names: Sequence[str],
    sensor: Sequence[str] = (),
    pixels: Pixels | None = None,
    size: Tensor | None = None,
) -> MomentModel:
    """Return a lens's spots as functions of some of its parameters, by the reference tracer.

    Args:
        lens: as designed.
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
    nominal = {name: value.detach() for name, value in lens.variables(names).items()}
    names = tuple(names)
    start = torch.stack([nominal[name] for name in names])
    ray = Components(*(c.double() for c in spots.rays.components()))
    wavelength = spots.rays.wavelength

    def land(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        system = lens.system(dict(zip(names, values.unbind(), strict=True)))
        last = trace_surfaces(system, ray, wavelength)
        traced = trace_to_sensor(system, last, wavelength)
        ends = [m for row in traced.margins for m in (row.met, row.transmitted) if m is not None]
        margin = torch.stack([end.detach().amin() for end in ends]).amin()
        at = traced.ray
        return torch.stack([at.x, at.y]), torch.stack([at.l / at.n, at.m / at.n]), margin

    shares = spots.weight.new_zeros(len(spots.weight), spots.count)
    shares[torch.arange(len(spots.weight)), spots.spot] = spots.weight
    with torch.no_grad():
        points, _, _ = land(start)
        centroids = (points @ shares).T
        apart = points - centroids.T[:, spots.spot]
        own_size = (apart.square().sum(0) @ shares).sqrt()
    chosen = torch.eye(len(SENSOR), dtype=start.dtype)[[SENSOR.index(name) for name in sensor]]
    return MomentModel(
        (*names, *sensor),
        start,
        chosen,
        shares,
        own_size if size is None else size,
        centroids,
        land,
        pixels,
    )
