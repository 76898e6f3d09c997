"""Numbers of many lenses carry their derivatives along, in forward mode.

`torch.func.jvp` under `vmap` does the same at five times the cost, since it decomposes and
dispatches every operation; the few that paraxial optics needs stand here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


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
