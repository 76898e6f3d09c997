"""Paraxial rays pass gradient-index media; see `dolens.optics.bent_motion`."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.bent_motion import Motion, carry, plain, steps_through
from dolens.optics.gradients import Bend, Number, Profile


class BentGap(NamedTuple):
    """A gap of a gradient takes paraxial rays (y, n·u) to (a·y + b·n·u, c·y + d·n·u).

    Attributes:
        a: of the height.
        b: of the height, mm.
        c: of the slope, 1/mm.
        d: of the slope.
        behind: the index at its end, as paraxial optics takes it.
    """

    a: Number
    b: Number
    c: Number
    d: Number
    behind: Number


# Nodes of Gauss and Legendre along its axis.
_NODES = 20


@lru_cache(maxsize=1)
def _gauss() -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return nodes and weights of Gauss and Legendre on [0, 1] (Golub and Welsch)."""
    k = torch.arange(1, _NODES, dtype=torch.float64)
    off = k / (4.0 * k * k - 1.0).sqrt()
    values, vectors = torch.linalg.eigh(torch.diag(off, 1) + torch.diag(off, -1))
    return tuple((0.5 * (values + 1.0)).tolist()), tuple((vectors[0] ** 2).tolist())


def bent_gap(
    profile: Profile, base: Number, start: Number, thickness: Number, meridian: str | None = None
) -> BentGap:
    """Return the paraxial gap of a gradient.

    y'' = κ·y along t with κ = ½·∂²n²/∂y² on the axis; n·u = dy/dt.  Terms in x and y alone, which
    tilt the axis, are left out.

    Args:
        profile: of the gradient.
        base: index of its homogeneous profile.
        start: z of the gap's beginning from the vertex that the profile counts from, mm.
        thickness: with its sign, mm.
        meridian: section `x` or `y`; None: the mean.

    Raises:
        InputError: the index is not positive there.
    """

    def index(z: Number) -> Number:
        squared = profile.bend(base, 0.0, 0.0, z).squared
        if not plain(squared) > 0.0:
            raise InputError(
                f"a gradient of the index: its index is not positive on the axis at {plain(z):g} "
                "mm from the surface in front"
            )
        return squared**0.5

    way = -1.0 if plain(thickness) < 0.0 else 1.0
    curvature = profile.curvature(meridian)
    behind = index(start + thickness)
    if not profile.axial:
        n = index(0.0)
        kappa = curvature if profile.squared else 2.0 * n * curvature
        return BentGap(*_exponential(kappa, way * thickness / n), behind)
    nodes, weights = _gauss()
    t = sum(
        w * (way * thickness) / index(start + u * thickness)
        for u, w in zip(nodes, weights, strict=True)
    )

    def bend(y: Number, y2: Number, z: Number) -> Bend:
        here = profile.bend(base, 0.0, 0.0, z)
        kappa = curvature if profile.squared else 2.0 * abs(here.squared) ** 0.5 * curvature
        return Bend(0.0, kappa * y, kappa * y2, here.z)

    begin = Motion(1.0, 0.0, start, 0.0, 1.0, way * index(start), 0.0)
    lengths = (plain(start), plain(thickness))
    steps = steps_through(profile, plain(base), *lengths, 1e-3 * abs(lengths[1]), torch.float64)
    end = carry(bend, begin, t, steps)
    return BentGap(end.x, end.y, end.tx, end.ty, behind)


def gap_of_gradient(
    thicknesses: Sequence[Number], origin: int, place: int
) -> tuple[Number, Number]:
    """Return where a gap begins, from the vertex that its profile counts from, and its length, mm.

    Args:
        thicknesses: of all gaps.
        origin: number of the surface that the profile counts from.
        place: of the profile.
    """
    return sum(thicknesses[origin - 1 : place - 1], 0.0), thicknesses[place - 1]


def paraxial_gaps(
    thicknesses: Sequence[Number],
    profiles: Mapping[int, tuple[int, Profile]],
    indices: Sequence[Number],
    senses: Sequence[float],
    meridian: str | None = None,
) -> list[Any]:
    """Return gaps as paraxial rays take them: lengths, and `BentGap` of gradients.

    Args:
        thicknesses: of all gaps, mm.
        profiles: place of a gradient → the surface that its profile counts from, and the profile.
        indices: of these alone, negative where light travels towards -z.
        senses: +1 where light travels towards +z, -1 towards -z; of all media.
        meridian: section `x` or `y`; None: the mean.
    """
    gaps = list(thicknesses)
    for (place, (origin, profile)), signed in zip(profiles.items(), indices, strict=True):
        sense = senses[place]
        start, length = gap_of_gradient(thicknesses, origin, place)
        gap = bent_gap(profile, sense * signed, start, length, meridian)
        gaps[place - 1] = gap._replace(behind=sense * gap.behind)
    return gaps


def _exponential(kappa: Number, t: Number) -> tuple[Number, Number, Number, Number]:
    """Return the matrix of y'' = κ·y over t."""
    cosine, ratio = _cosine_and_ratio(kappa * t * t)
    return cosine, t * ratio, kappa * t * ratio, cosine


# Beneath it series of four terms are exact to rounding.
_SMALL = 1e-3


def _cosine_and_ratio(s: Number) -> tuple[Number, Number]:
    """Return cosh √s and sinh √s / √s, which are cos √-s and sin √-s / √-s for negative s."""
    near = (
        1.0 + s * (1.0 / 2.0 + s * (1.0 / 24.0 + s / 720.0)),
        1.0 + s * (1.0 / 6.0 + s * (1.0 / 120.0 + s / 5040.0)),
    )
    if not isinstance(s, Tensor):
        if abs(s) < _SMALL:
            return near
        root = abs(s) ** 0.5
        both = (math.cos, math.sin) if s < 0.0 else (math.cosh, math.sinh)
        return both[0](root), both[1](root) / root
    # What is not chosen stays finite, so that its derivative does.
    root = s.abs().clamp(_SMALL, 1e5).sqrt()
    small, turns = s.abs() < _SMALL, s < 0.0
    cosine = torch.where(turns, root.cos(), root.cosh())
    ratio = torch.where(turns, root.sin(), root.sinh()) / root
    return torch.where(small, near[0], cosine), torch.where(small, near[1], ratio)
