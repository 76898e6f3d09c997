"""A clear aperture passes light: circles, rectangles, ellipses and polygons, with obscurations."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.table import Figure
from dolens.kernels.table import Outline as OutlineKind
from dolens.optics.surfaces.obscurations import Ring, Spider, Together
from dolens.optics.surfaces.outlines import CENTRE, Figures, Polygons, Simple, require_length


@dataclass(frozen=True)
class Circle(Simple):
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

    def figures(self) -> Figures:
        """Return an ellipse of equal axes, and the bounds of its x² + y², mm²."""
        return [(Figure.ELLIPTIC, CENTRE, (1.0, 1.0, -1.0, self.semi_diameter**2))]


@dataclass(frozen=True)
class Rectangle(Simple):
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

    def figures(self) -> Figures:
        """Return its sides as those of a polygon."""
        a, b = self.half_width_x, self.half_width_y
        return Polygons((((a, b), (-a, b), (-a, -b), (a, -b)),)).figures()


@dataclass(frozen=True)
class Ellipse(Simple):
    """The outline is an ellipse about the vertex, its axes along the surface's x and y; lengths in
    mm.
    """

    rotational: ClassVar[bool] = False
    semi_axis_x: float
    semi_axis_y: float

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return 1 - (x/a)² - (y/b)², positive strictly inside."""
        u, v = x / self.semi_axis_x, y / self.semi_axis_y
        return 1.0 - torch.addcmul(u * u, v, v)

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far inside the edge a point is, mm, along the line to the centre; negative
        outside.
        """
        u, v = x / self.semi_axis_x, y / self.semi_axis_y
        tiny = torch.finfo(u.dtype).tiny
        share = torch.addcmul(u * u, v, v).clamp(min=tiny).sqrt()
        radius = torch.addcmul(x * x, y, y).clamp(min=tiny).sqrt()
        inner = min(self.semi_axis_x, self.semi_axis_y)
        return torch.where(share > 1e-12, radius / share - radius, inner)

    @property
    def semi_diameter(self) -> float:
        """Return the longer semi-axis, mm."""
        return max(self.semi_axis_x, self.semi_axis_y)

    @property
    def extent(self) -> tuple[float, float]:
        """Return how far it reaches along x and along y, mm."""
        return self.semi_axis_x, self.semi_axis_y

    def packed(self) -> tuple[OutlineKind, float, float]:
        """Return its kind and 1/a², 1/b² (mm^-2) for the kernels."""
        return OutlineKind.ELLIPSE, self.semi_axis_x**-2, self.semi_axis_y**-2

    def figures(self) -> Figures:
        """Return its 1/a² and 1/b² (mm^-2), and the bounds of (x/a)² + (y/b)²."""
        return [(Figure.ELLIPTIC, CENTRE, (*self.packed()[1:], -1.0, 1.0))]


@dataclass(frozen=True)
class Unlimited(Simple):
    """The outline has no edge: light passes wherever the surface is.  A prescription says so
    (`clips: false`), and a search for a better lens needs it.

    Attributes:
        semi_diameter: mm, how far from the vertex light is expected; the surface is drawn to it,
            and it sets the scale of tolerances.
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

    @property
    def drawn(self) -> Circle:
        """Return the circle that light is expected in."""
        return Circle(self.semi_diameter)

    def packed(self) -> tuple[OutlineKind, float, float]:
        """Return its kind for the kernels, and no numbers."""
        return OutlineKind.NONE, 0.0, 0.0


Outline = Circle | Rectangle | Ellipse | Polygons | Ring | Spider | Together | Unlimited


@dataclass(frozen=True)
class ClearAperture:
    """Light passes strictly inside `edge`, and strictly outside `obscuration` where there is one.

    Attributes:
        edge: the outer limit.
        obscuration: what is blocked, as by a telescope's secondary mirror and the spider that
            holds it; or None.
        window: a second limit, no circle, that light must also pass: that of a stop whose edge, a
            circle, is the pupil's; or None.
        center: x and y (mm) of the window, the obscuration, and an edge that is no circle; that of
            an off-axis part is beside the vertex.
    """

    edge: Outline
    obscuration: Outline | None = None
    window: Outline | None = None
    center: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.window is not None and not isinstance(self.edge, Circle):
            raise InputError("a second outline goes with a circular edge")
        for outline in (self.edge, self.obscuration, self.window):
            for name, value in outline.lengths.items() if outline else ():
                require_length(name, value)
        if self.obscuration is not None and not isinstance(self.edge, Unlimited):
            # A disc about the vertex that is blocked for certain.
            reach = self.obscuration.inscribed - math.hypot(*self.center)
            if reach >= self.semi_diameter:
                raise InputError(
                    f"the obscuration reaches {reach:g} mm from the vertex, the aperture only "
                    f"{self.semi_diameter:g}"
                )

    @property
    def semi_diameter(self) -> float:
        """Return the distance of the edge's farthest point from the vertex, mm."""
        if isinstance(self.edge, Circle | Unlimited):
            return self.edge.semi_diameter
        return self.edge.semi_diameter + math.hypot(*self.center)

    @property
    def clips(self) -> bool:
        """Return whether there is an edge that stops light."""
        return not isinstance(self.edge, Unlimited)

    @property
    def rotational(self) -> bool:
        """Return whether it looks the same from every azimuth."""
        hole = self.obscuration
        if self.window is not None or (hole is not None and any(self.center)):
            return False
        return self.edge.rotational and (hole is None or hole.rotational)

    def figures(self) -> list[tuple[bool, Figures]]:
        """Return the figures of outlines that have no numbers of their own for the kernels: with
        each list whether it blocks light.
        """
        limits = (self.window or self.edge, False), (self.obscuration, True)
        cx, cy = self.center
        return [
            (blocks, [(kind, (x + cx, y + cy), own) for kind, (x, y), own in outline.figures()])
            for outline, blocks in limits
            if outline is not None
            and not isinstance(outline, Unlimited)
            and outline.packed()[0] == OutlineKind.FIGURES
        ]

    def opened(self) -> "ClearAperture":
        """Return the same size with no edge and no obscuration: it clips nothing."""
        return ClearAperture(Unlimited(self.semi_diameter))

    def resized(self, semi_diameter: float) -> "ClearAperture":
        """Return the same aperture with another radius of its circular edge.

        Raises:
            InputError: the edge is no circle.
        """
        if not isinstance(self.edge, Circle):
            raise InputError("semi_diameter: only a circular aperture has one that can be varied")
        return replace(self, edge=Circle(semi_diameter))

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far a point is from the edge that stops light, mm, negative where it does;
        differentiable.
        """
        return self._combined(x, y, lambda outline, u, v: outline.depth(u, v))

    def margin(self, x: Tensor, y: Tensor) -> Tensor:
        """Return a number that is positive where light passes; no gradient."""
        return self._combined(x.detach(), y.detach(), lambda outline, u, v: outline.margin(u, v))

    def _combined(
        self, x: Tensor, y: Tensor, inside: Callable[[Outline, Tensor, Tensor], Tensor]
    ) -> Tensor:
        """Return the least of how far inside the edge and the window a point is, and how far
        outside the obscuration.
        """
        u, v = x, y
        if any(self.center):
            u, v = x - self.center[0], y - self.center[1]
        centred = isinstance(self.edge, Circle | Unlimited)
        found = inside(self.edge, *((x, y) if centred else (u, v)))
        if self.window is not None:
            found = torch.minimum(found, inside(self.window, u, v))
        if self.obscuration is not None:
            found = torch.minimum(found, -inside(self.obscuration, u, v))
        return found
