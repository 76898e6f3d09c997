"""An outline is a circle, a rectangle or an ellipse, or it is made of figures, as polygons are.

The kernels see the latter as a list of figures (`Figure`), each with a centre of its own.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.table import Figure
from dolens.kernels.table import Outline as OutlineKind

Point = tuple[float, float]
# Turns a margin at the centres of a grid's cells into the share of each where it is positive.
Covered = Callable[[Tensor], Tensor]
# Kind, centre and numbers of each figure; see `Figure`.
Figures = list[tuple[Figure, Point, tuple[float, ...]]]
CENTRE: Point = (0.0, 0.0)
# Of all polygons of an outline; light is compared with each side.
MOST_CORNERS = 10_000
# mm; the square of a length beyond leaves the range of numbers.
_LONGEST = 1e100


def require_length(what: str, value: float) -> None:
    """Raise `InputError` where a length of an outline (mm) is not positive, or is endless."""
    if not 0.0 < value <= _LONGEST:
        raise InputError(f"{what} must be positive and finite, not {value:g} mm")


class Simple:
    """An outline of one or two lengths is packed as they are."""

    @property
    def lengths(self) -> dict[str, float]:
        """Return the sizes that must be positive and finite, by name."""
        return dict(vars(self))

    @property
    def inscribed(self) -> float:
        """Return the radius of the largest disc about the centre that it covers, mm."""
        return min(self.lengths.values())

    def share(self, covered: Covered, x: Tensor, y: Tensor) -> Tensor:
        """Return the share of a grid's cells inside the outline."""
        return covered(self.margin(x, y))  # type: ignore[attr-defined]

    def scaled(self, factor: float) -> Any:
        """Return the outline with all lengths multiplied by a factor."""
        return replace(self, **{name: factor * size for name, size in self.lengths.items()})  # type: ignore[type-var]

    @property
    def drawn(self) -> Any:
        """Return the outline that figures show."""
        return self

    def row(self) -> dict[str, Any]:
        """Return the outline as a prescription writes it."""
        return dict(vars(self))


class Composite:
    """An outline of several parts is packed as a list of figures.

    Attributes:
        rotational: whether it looks the same from every azimuth.
        inscribed: radius (mm) of a disc about the centre that it surely covers.
        lengths: sizes that must be positive and finite, by name.
    """

    rotational: ClassVar[bool] = False
    inscribed: ClassVar[float] = 0.0

    @property
    def lengths(self) -> dict[str, float]:
        """Return the sizes that must be positive and finite; here they have been checked."""
        return {}

    def packed(self) -> tuple[OutlineKind, float, float]:
        """Return the kind for the kernels; the numbers stand in the figures."""
        return OutlineKind.FIGURES, 0.0, 0.0

    @property
    def drawn(self) -> Any:
        """Return the outline that figures show."""
        return self

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return a number that is positive strictly inside and zero on the outline."""
        raise NotImplementedError

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside the outline a point is, mm; negative outside; differentiable."""
        return self.margin(x, y)

    def share(self, covered: Covered, x: Tensor, y: Tensor) -> Tensor:
        """Return the share of a grid's cells inside the outline."""
        return covered(self.margin(x, y))


@dataclass(frozen=True)
class Polygons(Composite):
    """The outline is that of one or several closed polygons; vertices in mm.

    A point is inside where a line from it crosses the sides an odd number of times: several
    polygons pass light through each, and one inside another is a hole in it.  Sides are outside.
    """

    polygons: tuple[tuple[Point, ...], ...]

    def __post_init__(self) -> None:
        if not self.polygons:
            raise InputError("'polygons' is empty; it needs lists of at least three points [x, y]")
        count = sum(map(len, self.polygons))
        if count > MOST_CORNERS:
            raise InputError(
                f"'polygons' have {count} vertices together (allowed: {MOST_CORNERS} at most)"
            )
        for polygon in self.polygons:
            if len(polygon) < 3 or len(set(polygon)) != len(polygon):
                raise InputError("a polygon needs at least three vertices, and each of them once")
            if not all(math.isfinite(value) for vertex in polygon for value in vertex):
                raise InputError("a polygon's vertices must be finite (mm)")

    @classmethod
    def of_blades(cls, blades: float, semi_diameter: float, angle: float = 0.0) -> "Polygons":
        """Return the opening of an iris: a regular polygon with its corners on a circle.

        Args:
            blades: how many sides.
            semi_diameter: of the circle, mm.
            angle: of the first corner, degrees from +x towards +y.

        Raises:
            InputError: fewer than three blades or too many, or a number that is not finite.
        """
        if blades != int(blades) or not 3 <= blades <= 100:
            raise InputError(f"'blades' must be a whole number from 3 to 100, not {blades:g}")
        require_length("'semi_diameter'", semi_diameter)
        if not math.isfinite(angle):
            raise InputError(f"'angle' must be finite, not {angle}")
        turns = [math.radians(angle) + 2.0 * math.pi * k / blades for k in range(int(blades))]
        corners = [(semi_diameter * math.cos(t), semi_diameter * math.sin(t)) for t in turns]
        return cls((tuple(corners),))

    @property
    def sides(self) -> list[tuple[Point, Point]]:
        """Return all sides, from vertex to vertex."""
        return [
            (polygon[k - 1], polygon[k]) for polygon in self.polygons for k in range(len(polygon))
        ]

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the distance to the nearest side, mm: positive strictly inside."""
        odd, on = torch.zeros_like(x, dtype=torch.bool), torch.zeros_like(x, dtype=torch.bool)
        nearest = torch.full_like(x, math.inf)
        for (ax, ay), (bx, by) in self.sides:
            ex, ey = bx - ax, by - ay
            u, v = x - ax, y - ay
            cross = ex * v - ey * u
            # The vertex below counts and the one above does not: no corner is crossed twice.
            upwards = by > ay
            between = (y >= min(ay, by)) & (y < max(ay, by))
            odd = odd ^ (between & ((cross > 0.0) if upwards else (cross < 0.0)))
            along = (ex * u + ey * v) / (ex * ex + ey * ey)
            within = ((x - ax) * (x - bx) <= 0.0) & ((y - ay) * (y - by) <= 0.0)
            here = (cross == 0.0) & within
            on = on | here
            share = along.clamp(0.0, 1.0)
            p, q = u - share * ex, v - share * ey
            squared = torch.addcmul(p * p, q, q)
            nearest = torch.minimum(nearest, squared)
        distance = nearest.clamp(min=torch.finfo(nearest.dtype).tiny).sqrt()
        return torch.where(odd, distance, -distance).masked_fill(on, 0.0)

    @property
    def semi_diameter(self) -> float:
        """Return the distance of the farthest vertex, mm."""
        return max(math.hypot(*vertex) for polygon in self.polygons for vertex in polygon)

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far it reaches along x and along y, mm."""
        vertices = [vertex for polygon in self.polygons for vertex in polygon]
        return max(abs(x) for x, _ in vertices), max(abs(y) for _, y in vertices)

    def figures(self) -> Figures:
        """Return the sides, x and y of both ends of each."""
        sides = tuple(value for a, b in self.sides for value in (*a, *b))
        return [(Figure.POLYGON, CENTRE, sides)]

    def scaled(self, factor: float) -> "Polygons":
        """Return the outline with all lengths multiplied by a factor."""
        return Polygons(
            tuple(tuple((factor * x, factor * y) for x, y in polygon) for polygon in self.polygons)
        )

    def row(self) -> dict[str, Any]:
        """Return the outline as a prescription writes it."""
        return {"polygons": [[list(vertex) for vertex in polygon] for polygon in self.polygons]}

    def words(self, number: Callable[[float], str]) -> str:
        """Return a short description."""
        corners = " and ".join(str(len(polygon)) for polygon in self.polygons[:3])
        if len(self.polygons) > 3:
            return f"{len(self.polygons)} polygons"
        return f"polygon{'s' * (len(self.polygons) > 1)} of {corners} sides"
