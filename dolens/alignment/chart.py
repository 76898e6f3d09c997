"""A chart is a plane of bright marks, all alike, at known places."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.optics.elements import rotation_matrix

DISC, SQUARE = "disc", "square"
SHAPES = (DISC, SQUARE)
# Where the chart stands: mm, and radians about its centre.
CHART_POSE = (
    *("chart.x", "chart.y", "chart.z"),
    *("chart.tilt_x", "chart.tilt_y", "chart.tilt_z"),
)


@dataclass(frozen=True)
class Chart:
    """Describes bright marks on a dark plane, in rows and columns about its centre.

    Every point of a mark sends the same light into every direction towards the lens.

    Attributes:
        distance: of the chart's centre in front of the lens's first vertex as planned, mm.
        rows: of marks along y.
        columns: of marks along x.
        pitch: from mark to mark, mm.
        size: diameter of a disc or side of a square, mm.
        shape: `disc` or `square`.
        angle: by which a square's sides are turned about the chart's normal, degrees, so that its
            edges are slanted.

    Raises:
        InputError: a number out of range, or an unknown shape.
    """

    distance: float
    rows: int
    columns: int
    pitch: float
    size: float
    shape: str = DISC
    angle: float = 5.0

    def __post_init__(self) -> None:
        check_choice(self.shape, SHAPES, "chart.shape")
        for key in ("rows", "columns"):
            number = getattr(self, key)
            if not (type(number) is int and number >= 1):
                raise InputError(f"chart.{key}: {number!r}; allowed: an integer of 1 or more")
        for key in ("distance", "pitch", "size"):
            number = getattr(self, key)
            if not 0.0 < number < math.inf:
                raise InputError(f"chart.{key}: {number!r}; allowed: a positive number")
        if not self.size < self.pitch:
            raise InputError(f"chart.size: {self.size}; allowed: less than pitch, {self.pitch}")

    @property
    def count(self) -> int:
        """Return the number of marks."""
        return self.rows * self.columns

    def centres(self) -> Tensor:
        """Return the marks' centres (D, 2), x and y on the chart, mm; row after row."""
        y = self.pitch * (torch.arange(self.rows, dtype=torch.float64) - 0.5 * (self.rows - 1))
        x = self.pitch * (
            torch.arange(self.columns, dtype=torch.float64) - 0.5 * (self.columns - 1)
        )
        return torch.cartesian_prod(y, x).reshape(-1, 2).flip(-1)

    def quadrature(self) -> tuple[Tensor, Tensor]:
        """Return points of a mark about its centre (Q, 2), mm, and their shares of its area (Q,).

        A disc has Radon's seven points, exact up to the fifth order (Stroud, Approximate
        Calculation of Multiple Integrals, S2: 5-1): the centre with 1/4, and six at √(2/3) of
        the radius.  A square has Gauss and Legendre's 4 by 4, exact up to the seventh.
        """
        options: dict[str, Any] = {"dtype": torch.float64}
        if self.shape == DISC:
            angle = torch.arange(6, **options) * (math.pi / 3.0)
            ring = math.sqrt(2.0 / 3.0) * 0.5 * self.size
            around = ring * torch.stack([angle.cos(), angle.sin()], -1)
            share = torch.tensor([0.25] + 6 * [0.125], **options)
            return torch.cat([torch.zeros(1, 2, **options), around]), share
        inner, outer = (math.sqrt(3.0 / 7.0 + s * 2.0 / 7.0 * math.sqrt(1.2)) for s in (-1.0, 1.0))
        heavy, light = ((18.0 + s * math.sqrt(30.0)) / 72.0 for s in (1.0, -1.0))
        nodes = 0.5 * self.size * torch.tensor([-outer, -inner, inner, outer], **options)
        shares = torch.tensor([light, heavy, heavy, light], **options)
        points = torch.cartesian_prod(nodes, nodes)
        turn = math.radians(self.angle)
        rotation = torch.tensor(
            [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], **options
        )
        return points @ rotation.mT, torch.outer(shares, shares).flatten()

    def in_lens_axes(self, places: Tensor, pose: Tensor) -> Tensor:
        """Return places on the chart (..., 2), mm, in the lens's axes (..., 3), mm.

        A place p lies at (x, y, z - distance) + Rx·Ry·Rz·(p, 0): the chart turns about its centre.

        Args:
            places: x and y on the chart.
            pose: (6,), in the order of `CHART_POSE`, mm and radians.
        """
        rotation = rotation_matrix(*pose[3:].unbind())
        centre = pose[:3] + pose.new_tensor([0.0, 0.0, -self.distance])
        return places @ rotation[:, :2].mT + centre
