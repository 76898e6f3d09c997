"""A chart of bright marks, a posed sensor, and the windows of its photographs that show marks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.alignment.gaussian_filters import blurred, weights_on_grid
from dolens.errors import InputError, check_choice, check_count
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
            check_count(f"chart.{key}", getattr(self, key))
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


# A mark is looked for in a window that is blurred by so many pixels, and its centroid taken where
# it is at least so bright beside its peak.
_BLUR, _BRIGHT = 2.0, 0.3
# A weight reaches so many of its widths.
_REACH = 4.5
# A peak below so many standard deviations of the blurred noise is none.
_FAINT = 8.0


@dataclass(frozen=True)
class WeightedSums:
    """Holds sums of counts with K weights for each of D marks in N photographs.

    Attributes:
        counts: (N, D, K), electrons.
        background: (N, D, K), the sums of a background of one electron a pixel.
        products: (N, D, K, K), Σ D_k·D_l over pixels: of read noise of one electron.
        width: (N, D), σ, mm.
        centre: (N, D, 2), mm on the sensor.
    """

    counts: Tensor
    background: Tensor
    products: Tensor
    width: Tensor
    centre: Tensor


@dataclass(frozen=True)
class MarkWindows:
    """Holds the pixels about each of D marks in N photographs by one sensor.

    Attributes:
        counts: (N, D, H, W), electrons, the dark level taken off.
        x: (N, D, W), mm on the sensor, the middles of columns.
        y: (N, D, H), of rows.
        pitch: of pixels, mm.
        read_noise: RMS of a pixel, electrons.
    """

    counts: Tensor
    x: Tensor
    y: Tensor
    pitch: float
    read_noise: float

    def chosen(self, photographs: Sequence[int]) -> "MarkWindows":
        """Return some of the photographs, by their numbers from 0."""
        at = list(photographs)
        return replace(self, counts=self.counts[at], x=self.x[at], y=self.y[at])

    def located(self) -> Tensor:
        """Return the marks' centroids (N, D, 2), mm, right to about a pixel.

        Raises:
            InputError: a window shows no mark.
        """
        level = self.counts.flatten(2).median(-1).values
        smooth = blurred(self.counts - level[..., None, None], _BLUR)
        peak = smooth.amax((-2, -1))
        # A Gaussian of b pixels leaves noise 1/(2√π·b) of its deviation.
        noise = (level.clamp(min=0.0) + self.read_noise**2).sqrt() / (3.545 * _BLUR)
        faint = peak < _FAINT * noise
        if bool(faint.any()):
            photograph, mark = (int(i) + 1 for i in torch.nonzero(faint)[0])
            raise InputError(
                f"search_radius: photograph {photograph} shows no mark {mark} where one is; "
                "allowed: windows that hold each mark, see chart and planes"
            )
        light = torch.where(smooth > _BRIGHT * peak[..., None, None], smooth, 0.0)
        total = light.sum((-2, -1))
        x = (light.sum(-2) * self.x).sum(-1) / total
        y = (light.sum(-1) * self.y).sum(-1) / total
        return torch.stack([x, y], -1)

    def sums(self, centre: Tensor, width: Tensor, highest: int) -> WeightedSums:
        """Return sums of the counts with derivatives of Gaussians, see `gaussian_derivatives`.

        Args:
            centre: (N, D, 2), of the Gaussians, mm on the sensor.
            width: (N, D), mm.
            highest: order of the derivatives.

        Raises:
            InputError: a Gaussian reaches beyond its window.
        """
        for middles, about in ((self.x, centre[..., 0]), (self.y, centre[..., 1])):
            room = torch.minimum(about - middles.amin(-1), middles.amax(-1) - about)
            if bool((room < _REACH * width).any()):
                need = float((_REACH * width - room).max())
                raise InputError(
                    f"search_radius: a mark lies {need:.3g} mm too near its window's edge"
                )
        x, y = self.x - centre[..., :1], self.y - centre[..., 1:]
        along, down = weights_on_grid(x, y, width, highest)
        counts = ((down @ self.counts) * along).sum(-1)
        products = (along @ along.mT) * (down @ down.mT)
        return WeightedSums(counts, along.sum(-1) * down.sum(-1), products, width, centre)


# Where the sensor is besides its distance: mm across, and radians about the point on the axis.
SENSOR_POSE = ("sensor.x", "sensor.y", "sensor.tilt_x", "sensor.tilt_y")


class OnSensor(NamedTuple):
    """Points of light on a posed sensor, with their derivatives.

    Attributes:
        points: (..., 2), mm, along the sensor's own axes from its centre.
        by_point: (..., 2, 2), with respect to where the rays cross the plane z = 0.
        by_tangent: (..., 2, 2), mm, with respect to the rays' tangents.
        by_pose: (..., 2, 5), with respect to the pose of `SENSOR_POSE` and the plane.
    """

    points: Tensor
    by_point: Tensor
    by_tangent: Tensor
    by_pose: Tensor


def on_sensor(crossing: Tensor, tangent: Tensor, pose: Tensor, plane: float) -> OnSensor:
    """Return where rays meet a sensor, in its own axes.

    With O the sensor's centre, e₁ and e₂ its axes, n its normal, P where a ray crosses the plane
    z = 0 and t = (l/n, m/n, 1), the ray meets it at p = P + s·t, s = n·(O - P)/(n·t), seen at
    e·(p - O).  A displacement dP moves that by e·(dP - t (n·dP)/(n·t)), a turn ω of the sensor
    by (ω×e)·(p - O) + e·t (ω×n)·(O - p)/(n·t), and dt by s times what dP does.

    Args:
        crossing: (..., 2), mm, of the rays with the plane of the sensor as planned.
        tangent: (..., 2), their l/n and m/n.
        pose: (4,), in the order of `SENSOR_POSE`, mm and radians.
        plane: by how much the sensor stands farther from the lens, mm.
    """
    zero = torch.zeros_like(pose[0])
    rotation = rotation_matrix(pose[2], pose[3], zero)
    axes, normal = rotation[:, :2].mT, rotation[:, 2]
    centre = torch.stack([pose[0], pose[1], zero + plane])
    start = torch.cat([crossing, torch.zeros_like(crossing[..., :1])], -1)
    t = torch.cat([tangent, torch.ones_like(tangent[..., :1])], -1)
    cosine = t @ normal
    s = ((centre - start) @ normal) / cosine
    apart = start + s[..., None] * t - centre
    along = t @ axes.mT
    # e_i·(1 - t nᵀ/(n·t)), (..., 2, 3).
    full = axes - along[..., :, None] * (normal / cosine[..., None])[..., None, :]
    # dR/dα = ω×R: x is turned last, so its ω is the lens's x axis; y's is Rx·(0, 1, 0).
    about_x = torch.stack([zero + 1.0, zero, zero])
    about_y = torch.stack([zero, torch.cos(pose[2]), torch.sin(pose[2])])
    turned = []
    for omega in (about_x, about_y):
        moved_axes = torch.linalg.cross(omega.expand_as(axes), axes)
        moved_normal = torch.linalg.cross(omega, normal)
        slip = -(apart @ moved_normal) / cosine
        turned.append(apart @ moved_axes.mT + along * slip[..., None])
    by_pose = torch.cat(
        [-full[..., :2], torch.stack(turned, -1), -full[..., 2:]],
        -1,
    )
    by_point = full[..., :2]
    return OnSensor(apart @ axes.mT, by_point, s[..., None, None] * by_point, by_pose)
