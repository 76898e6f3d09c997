"""Obscurations block light: rings, the arms of a spider, and several of them together."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.table import Figure
from dolens.optics.surfaces.outlines import (
    CENTRE,
    Composite,
    Covered,
    Figures,
    Point,
    require_length,
)


@dataclass(frozen=True)
class Ring(Composite):
    """The outline is the ring between two circles about the centre; lengths in mm."""

    rotational: ClassVar[bool] = True
    inner_semi_diameter: float
    semi_diameter: float

    def __post_init__(self) -> None:
        require_length("inner_semi_diameter", self.inner_semi_diameter)
        require_length("semi_diameter", self.semi_diameter)
        if self.inner_semi_diameter >= self.semi_diameter:
            raise InputError(
                f"inner_semi_diameter {self.inner_semi_diameter:g} must be below semi_diameter "
                f"{self.semi_diameter:g}"
            )

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the lesser of ρ² - r² and r² - ρ² of both circles, mm²."""
        square = torch.addcmul(x * x, y, y)
        return torch.minimum(self.semi_diameter**2 - square, square - self.inner_semi_diameter**2)

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside the nearer circle a point is, mm; negative outside."""
        square = torch.addcmul(x * x, y, y)
        radius = square.clamp(min=torch.finfo(square.dtype).tiny).sqrt()
        return torch.minimum(self.semi_diameter - radius, radius - self.inner_semi_diameter)

    def share(self, covered: Covered, x: Tensor, y: Tensor) -> Tensor:
        """Return the larger disc's share of cells less the smaller one's."""
        square = torch.addcmul(x * x, y, y)
        outer = covered(self.semi_diameter**2 - square)
        return outer - covered(self.inner_semi_diameter**2 - square)

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far it reaches along x and along y, mm."""
        return self.semi_diameter, self.semi_diameter

    def figures(self) -> Figures:
        """Return an ellipse of equal axes, and the bounds of its x² + y², mm²."""
        bounds = (self.inner_semi_diameter**2, self.semi_diameter**2)
        return [(Figure.ELLIPTIC, CENTRE, (1.0, 1.0, *bounds))]

    def scaled(self, factor: float) -> "Ring":
        """Return the outline with all lengths multiplied by a factor."""
        return Ring(factor * self.inner_semi_diameter, factor * self.semi_diameter)

    def row(self) -> dict[str, Any]:
        """Return the outline as a prescription writes it."""
        return dict(vars(self))

    def words(self, number: Callable[[float], str]) -> str:
        """Return a short description."""
        return f"ring {number(self.inner_semi_diameter)} to {number(self.semi_diameter)}"


@dataclass(frozen=True)
class Spider(Composite):
    """The outline is that of arms of one width from the centre outwards, at equal angles.

    Attributes:
        width: of each arm, mm.
        arms: how many.
        angle: of the first, degrees from +x towards +y.
    """

    width: float
    arms: int
    angle: float = 0.0

    def __post_init__(self) -> None:
        require_length("a spider's width", self.width)
        if self.arms != int(self.arms) or not 1 <= self.arms <= 1000:
            raise InputError(f"a spider's arms must be a whole number from 1, not {self.arms}")
        if not math.isfinite(self.angle):
            raise InputError(f"a spider's angle must be finite, not {self.angle}")

    @property
    def directions(self) -> list[Point]:
        """Return the unit vector along each arm."""
        found = []
        for k in range(int(self.arms)):
            # Whole right angles are exact.
            turn = self.angle + 360.0 * k / int(self.arms)
            quarters = round(turn / 90.0)
            rest = math.radians(turn - 90.0 * quarters)
            c, s = math.cos(rest), math.sin(rest)
            found.append([(c, s), (-s, c), (-c, -s), (s, -c)][quarters % 4])
        return found

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside an arm's sides and its end a point is, mm."""
        found: Tensor | None = None
        for c, s in self.directions:
            along, across = c * x + s * y, c * y - s * x
            inside = torch.minimum(0.5 * self.width - across.abs(), along)
            found = inside if found is None else torch.maximum(found, inside)
        assert found is not None  # there is an arm
        return found

    def share(self, covered: Covered, x: Tensor, y: Tensor) -> Tensor:
        """Return the share of cells under the arms, also of arms narrower than a cell."""
        found = torch.zeros_like(x)
        for c, s in self.directions:
            along, across = c * x + s * y, c * y - s * x
            half = 0.5 * self.width
            arm = (covered(half - across) + covered(half + across) - 1.0).clamp(min=0.0)
            found = torch.maximum(found, torch.minimum(arm, covered(along)))
        return found

    @property
    def semi_diameter(self) -> float:
        """Return infinity: arms end at the aperture's edge."""
        return math.inf

    @property
    def extent(self) -> tuple[float, float]:
        """Return infinity along x and along y."""
        return math.inf, math.inf

    def figures(self) -> Figures:
        """Return cosine and sine of each arm and half its width, mm."""
        return [(Figure.ARM, CENTRE, (c, s, 0.5 * self.width)) for c, s in self.directions]

    def scaled(self, factor: float) -> "Spider":
        """Return the outline with its width multiplied by a factor."""
        return Spider(factor * self.width, self.arms, self.angle)

    def row(self) -> dict[str, Any]:
        """Return the outline as a prescription writes it."""
        row: dict[str, Any] = {"width": self.width, "arms": int(self.arms)}
        return row | ({"angle": self.angle} if self.angle else {})

    def words(self, number: Callable[[float], str]) -> str:
        """Return a short description."""
        return f"spider of {int(self.arms)} arms {number(self.width)} wide"


@dataclass(frozen=True)
class Together(Composite):
    """The outline is that of several parts, each about a centre of its own; any of them blocks.

    Attributes:
        parts: outlines, and x and y (mm) of their centres.
    """

    parts: tuple[tuple[Any, Point], ...]

    @property
    def rotational(self) -> bool:  # type: ignore[override]
        """Return whether it looks the same from every azimuth."""
        return all(part.rotational and center == CENTRE for part, center in self.parts)

    @property
    def lengths(self) -> dict[str, float]:
        """Return the sizes that must be positive and finite, by name."""
        return {name: size for part, _ in self.parts for name, size in part.lengths.items()}

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return a number that is positive strictly inside a part; its size has no unit."""
        return self._largest(x, y, lambda part, u, v: part.margin(u, v))

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside the nearest part a point is, mm; negative outside."""
        return self._largest(x, y, lambda part, u, v: part.depth(u, v))

    def share(self, covered: Covered, x: Tensor, y: Tensor) -> Tensor:
        """Return the largest of the parts' shares of cells."""
        return self._largest(x, y, lambda part, u, v: part.share(covered, u, v))

    def _largest(
        self, x: Tensor, y: Tensor, number: Callable[[Any, Tensor, Tensor], Tensor]
    ) -> Tensor:
        found = [number(part, x - cx, y - cy) for part, (cx, cy) in self.parts]
        return reduce(torch.maximum, found)

    @property
    def semi_diameter(self) -> float:
        """Return the distance of the farthest point, mm."""
        return max(part.semi_diameter + math.hypot(*center) for part, center in self.parts)

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far it reaches along x and along y, mm."""
        reach = [
            (part.extent[0] + abs(cx), part.extent[1] + abs(cy)) for part, (cx, cy) in self.parts
        ]
        return max(x for x, _ in reach), max(y for _, y in reach)

    def figures(self) -> Figures:
        """Return the figures of all parts."""
        return [
            (kind, (x + cx, y + cy), numbers)
            for part, (cx, cy) in self.parts
            for kind, (x, y), numbers in part.figures()
        ]

    def scaled(self, factor: float) -> "Together":
        """Return the outline with all lengths multiplied by a factor."""
        return Together(
            tuple((part.scaled(factor), (factor * x, factor * y)) for part, (x, y) in self.parts)
        )

    def words(self, number: Callable[[float], str]) -> str:
        """Return a short description."""
        return f"{len(self.parts)} obscurations"
