"""Points that send light into a lens, near ones and infinitely far ones alike."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError


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
