"""Moments describe the spots of a lens in a few numbers each, with their derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.moments import (
    POWERS,
    shift_derivatives,
    sums_and_derivatives,
    weighted_sums,
)
from dolens.alignment.pixel_moments import Pixels, convolved, pixel_convolution
from dolens.alignment.spot_intercepts import SpotIntercepts, spot_intercepts
from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError, check_choice
from dolens.optics.lens import Lens
from dolens.optics.straight import require_plane_sensor

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
