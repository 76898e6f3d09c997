"""A clear aperture passes light: circles and rectangles, with obscurations."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.table import Outline as OutlineKind


@dataclass(frozen=True)
class Circle:
    """The outline is a circle about the vertex; lengths in mm."""

    rotational: ClassVar[bool] = True  # it looks the same from every azimuth
    semi_diameter: float

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return ρ² - r², mm²: positive strictly inside."""
        return self.semi_diameter**2 - torch.addcmul(x * x, y, y)

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside the edge a point is, mm; negative outside.  It is differentiable
        but at the vertex.
        """
        square = torch.addcmul(x * x, y, y)
        return self.semi_diameter - square.clamp(min=torch.finfo(square.dtype).tiny).sqrt()

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far it reaches along x and along y, mm."""
        return self.semi_diameter, self.semi_diameter

    def packed(self) -> tuple[OutlineKind, float, float]:
        """Return its kind and two numbers for the kernels; here r² (mm²) and nothing."""
        return OutlineKind.CIRCLE, self.semi_diameter**2, 0.0


@dataclass(frozen=True)
class Rectangle:
    """The outline is a rectangle about the vertex, its sides along the surface's x and y; lengths
    in mm.
    """

    rotational: ClassVar[bool] = False
    half_width_x: float
    half_width_y: float

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the distance to the nearest side, mm: positive strictly inside."""
        return torch.minimum(self.half_width_x - x.abs(), self.half_width_y - y.abs())

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside the nearest side a point is, mm; negative outside."""
        return self.margin(x, y)

    @property
    def semi_diameter(self) -> float:
        """Return the distance of its corners from the vertex, mm."""
        return math.hypot(self.half_width_x, self.half_width_y)

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far it reaches along x and along y, mm."""
        return self.half_width_x, self.half_width_y

    def packed(self) -> tuple[OutlineKind, float, float]:
        """Return its kind and its half widths (mm) for the kernels."""
        return OutlineKind.RECTANGLE, self.half_width_x, self.half_width_y


@dataclass(frozen=True)
class Unlimited:
    """The outline has no edge: light passes wherever the surface is, as a search for a better lens
    needs it.

    Attributes:
        semi_diameter: mm, how far from the vertex light is expected; it sets the scale of
            tolerances.
    """

    rotational: ClassVar[bool] = True
    semi_diameter: float

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return a positive number everywhere."""
        return torch.ones_like(x * y)

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the reach everywhere, since there is no edge."""
        return self.semi_diameter * self.margin(x, y)

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far light is expected along x and along y, mm."""
        return self.semi_diameter, self.semi_diameter

    def packed(self) -> tuple[OutlineKind, float, float]:
        """Return its kind for the kernels, and no numbers."""
        return OutlineKind.NONE, 0.0, 0.0


Outline = Circle | Rectangle | Unlimited


@dataclass(frozen=True)
class ClearAperture:
    """Light passes strictly inside `edge`, and strictly outside `obscuration` where there is one.

    Attributes:
        edge: the outer limit.
        obscuration: what is blocked in the middle, as in a telescope; or None.
    """

    edge: Outline
    obscuration: Outline | None = None

    def __post_init__(self) -> None:
        for outline in (self.edge, self.obscuration):
            for name, value in vars(outline).items() if outline else ():
                if not 0.0 < value < math.inf:
                    raise InputError(f"{name} must be positive and finite, not {value}")
        if (
            self.obscuration is not None
            and self.obscuration.semi_diameter >= self.edge.semi_diameter
        ):
            raise InputError(
                f"the obscuration reaches {self.obscuration.semi_diameter:g} mm from the vertex, "
                f"the aperture only {self.edge.semi_diameter:g}"
            )

    @property
    def rotational(self) -> bool:
        """Return whether it looks the same from every azimuth."""
        return self.edge.rotational and (self.obscuration is None or self.obscuration.rotational)

    def opened(self) -> "ClearAperture":
        """Return the same size with no edge and no obscuration: it clips nothing."""
        return ClearAperture(Unlimited(self.edge.semi_diameter))

    def resized(self, semi_diameter: float) -> "ClearAperture":
        """Return the same aperture with another radius of its circular edge.

        Raises:
            InputError: the edge is no circle.
        """
        if not isinstance(self.edge, Circle):
            raise InputError("semi_diameter: only a circular aperture has one that can be varied")
        return ClearAperture(Circle(semi_diameter), self.obscuration)

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far a point is from the edge that stops light, mm, negative where it does;
        differentiable.
        """
        inside = self.edge.depth(x, y)
        if self.obscuration is None:
            return inside
        return torch.minimum(inside, -self.obscuration.depth(x, y))

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return a number that is positive where light passes; no gradient."""
        x, y = x.detach(), y.detach()
        inside = self.edge.margin(x, y)
        if self.obscuration is None:
            return inside
        return torch.minimum(inside, -self.obscuration.margin(x, y))
