"""Paraxial rays of many lenses of one arrangement are traced at once, with derivatives.

Numbers are tensors (L,), or `Tangents`, which carry derivatives in forward mode:
`torch.func.jvp` under `vmap` does the same at five times the cost, since it decomposes and
dispatches every operation.  Lengths are in units of the focal length that is asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from dolens.lens_search.arrangement import Arrangement
from dolens.optics.paraxial import UNIT_RAYS, Number, through_surfaces


@dataclass(frozen=True)
class LensNumbers:
    """The numbers of L lenses: tensors (L,), or such with their derivatives.

    Attributes:
        curvatures: S of the refracting surfaces.
        gaps: G between neighbours of the sequence.
        image: from the last of the sequence to the sensor.
        indices: S + 1 of them: in front of the lens and behind each refracting surface.
        coefficients: of each refracting surface, r⁴ first; none of a sphere.
    """

    curvatures: Sequence[Number]
    gaps: Sequence[Number]
    image: Number
    indices: Sequence[Number]
    coefficients: Sequence[Sequence[Number]] = ()


@dataclass(frozen=True)
class Paraxial:
    """Paraxial numbers of L lenses.

    Attributes:
        power: 1/focal length, (L,).
        back_focus: from the last refracting surface to the focus, (L,).
        entrance_pupil: from the first of the sequence to the entrance pupil, (L,).
        marginal: heights on the S refracting surfaces of a ray parallel to the axis at height 1.
        chief: heights there of a ray of slope 1 through the middle of the stop.
        stop_height: height of the first of these rays at the stop.
    """

    power: Number
    back_focus: Number
    entrance_pupil: Number
    marginal: Sequence[Number]
    chief: Sequence[Number]
    stop_height: Number


def numbers_of(
    arrangement: Arrangement, variables: Sequence[Number], indices: Sequence[Number]
) -> LensNumbers:
    """Return the numbers of lenses by their variables.

    Args:
        arrangement: the order.
        variables: curvatures, gaps, the sensor's distance and the coefficients of aspheres.
        indices: at the reference wavelength, as in `LensNumbers`.
    """
    s, g = arrangement.surfaces, arrangement.gaps
    coefficients = [[variables[n] for n in own] for own in arrangement.coefficient_columns]
    return LensNumbers(variables[:s], variables[s : s + g], variables[s + g], indices, coefficients)


def paraxial(arrangement: Arrangement, lenses: LensNumbers) -> Paraxial:
    """Trace two paraxial rays through L lenses (Welford, ch. 3)."""
    curvatures, gaps, indices = lenses.curvatures, lenses.gaps, lenses.indices
    # Of the sequence, so many surfaces stand in front of the stop.
    k = arrangement.stop_place
    front = list(through_surfaces(UNIT_RAYS, curvatures[:k], gaps, indices))
    at_stop = rays = front[-1] if front else UNIT_RAYS
    if front:
        at_stop = rays = rays.transferred(gaps[k - 1], indices[k])
    if k < len(curvatures):
        rays = rays.transferred(gaps[k], indices[k])
    behind = list(through_surfaces(rays, curvatures[k:], gaps[k + 1 :], indices[k:]))
    met = [*front, *behind]
    back = met[-1]
    # Through the middle of the stop: y₁·A + slope·B = 0.
    height = -at_stop.y2 / at_stop.y
    return Paraxial(
        power=-back.nu,
        back_focus=-back.y / back.nu,
        entrance_pupil=-height,
        marginal=[ray.y for ray in met],
        chief=[height * ray.y + ray.y2 for ray in met],
        stop_height=at_stop.y,
    )


def petzval_sum(lenses: LensNumbers) -> Number:
    """Return Σ (n' - n)·c/(n·n'), (L,); 0 is a flat field, 1 that of a thin lens with n = 1."""
    media = pairwise(lenses.indices)
    return sum(
        c * (after - before) / (before * after)
        for c, (before, after) in zip(lenses.curvatures, media, strict=True)
    )


@dataclass(frozen=True)
class Tangents:
    """Numbers of L lenses with their derivatives with respect to P variables.

    Attributes:
        rows: (..., 1 + P, L): the values, then their derivatives.
    """

    rows: Tensor

    @staticmethod
    def variables(values: Tensor) -> "list[Tangents]":
        """Return the P variables of L lenses, (L, P), each with a derivative of one by itself."""
        lenses, count = values.shape
        found = []
        for column in range(count):
            rows = values.new_zeros(1 + count, lenses)
            rows[0], rows[1 + column] = values[:, column], 1.0
            found.append(Tangents(rows))
        return found

    @staticmethod
    def stacked(numbers: "Sequence[Tangents]") -> "Tangents":
        """Return several as one, with a leading dimension."""
        return Tangents(torch.stack([number.rows for number in numbers]))

    def __getitem__(self, places: "Sequence[int]") -> "Tangents":
        """Return some of several that were stacked."""
        return Tangents(self.rows[places])

    @property
    def value(self) -> Tensor:
        """Return the values, (..., L)."""
        return self.rows[..., 0, :]

    def __add__(self, other: "Tangents | Tensor | float") -> "Tangents":
        if isinstance(other, Tangents):
            return Tangents(self.rows + other.rows)
        rows = self.rows.clone()
        rows[..., 0, :] += other
        return Tangents(rows)

    __radd__ = __add__

    def __neg__(self) -> "Tangents":
        return Tangents(-self.rows)

    def __sub__(self, other: "Tangents | Tensor | float") -> "Tangents":
        if isinstance(other, Tangents):
            return Tangents(self.rows - other.rows)
        return self + (-other)

    def __rsub__(self, other: "Tensor | float") -> "Tangents":
        return -self + other

    def __mul__(self, other: "Tangents | Tensor | float") -> "Tangents":
        if not isinstance(other, Tangents):
            return Tangents(self.rows * _beside(other))
        return self._with(self.value * other.value, other.value, other.rows, self.value)

    __rmul__ = __mul__

    def __truediv__(self, other: "Tangents | Tensor | float") -> "Tangents":
        if not isinstance(other, Tangents):
            return Tangents(self.rows / _beside(other))
        inverse = 1.0 / other.value
        value = self.value * inverse
        return self._with(value, inverse, other.rows, -value * inverse)

    def _with(self, value: Tensor, own: Tensor, others: Tensor, other: Tensor) -> "Tangents":
        """Return `value` with derivatives own·∂self + other·∂others."""
        rows = torch.addcmul(self.rows * own[..., None, :], others, other[..., None, :])
        rows[..., 0, :] = value
        return Tangents(rows)

    def _of(self, value: Tensor, slope: Tensor) -> "Tangents":
        rows = self.rows * slope[..., None, :]
        rows[..., 0, :] = value
        return Tangents(rows)

    def abs(self) -> "Tangents":
        """Return the magnitude."""
        return Tangents(self.rows * self.value.sign()[..., None, :])

    def sqrt(self) -> "Tangents":
        """Return the square root."""
        root = self.value.sqrt()
        return self._of(root, 0.5 / root)

    def clamp(self, low: float, high: float) -> "Tangents":
        """Return the number within an interval; outside it has no derivative."""
        inside = (self.value > low) & (self.value < high)
        return self._of(self.value.clamp(low, high), inside.to(self.rows))

    def maximum(self, other: "Tangents") -> "Tangents":
        """Return the greater of two, with its derivative."""
        return Tangents(
            torch.where((self.value >= other.value)[..., None, :], self.rows, other.rows)
        )


def _beside(factor: Tensor | float) -> Tensor | float:
    """Return a factor (..., L) as it multiplies rows (..., 1 + P, L)."""
    return factor[..., None, :] if isinstance(factor, Tensor) and factor.ndim else factor
