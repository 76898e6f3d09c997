"""Gradient-index media: the profile of their index, and rays that bend in them.

Along a ray let dt = ds/n, s being its length.  Position r and optical direction T = dr/dt, whose
length is n, then follow (Sharma, Kumar and Ghatak, Appl. Opt. 21, 984 (1982))

    dr/dt = T,   dT/dt = ½·∇n²(r),   dP/dt = ½·T² + ½·n²(r)

with P the optical path ∫n·ds.  The two halves, T at rest and r at rest, are each solved exactly,
and a symplectic splitting of order six joins them (Blanes and Moan, J. Comput. Appl. Math. 142, 313
(2002), SRKN 11).  P is the action of this motion, and has the same order.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from dolens.errors import InputError
from dolens.kernels.table import DRIFTS, KICKS
from dolens.optics.autograd import is_transformed

Number = Any  # of Python's, or a tensor

RADIAL = ("r2", "r4", "r6", "r8", "r10", "r12")
AXIAL = ("z", "z2", "z3", "z4")
ACROSS = ("x", "x2", "y", "y2")
TERMS = (*RADIAL, *AXIAL, *ACROSS)

# So many rays are traced once more for their derivatives, whose memory is then that of a step.
_MANY = 4096
# Steps per radian of phase, of which a parabolic profile has 2π a pitch, and the fewest: they err
# by 1e-12 in double precision.
_STEPS = {torch.float64: (8.0, 6), torch.float32: (2.0, 2)}
_MOST_STEPS = 4096
# Points along and across a gap at which its profile is looked at.
_LOOKS = 17


class Bend(NamedTuple):
    """The square of the index at a point, and half of its gradient; 0.0 where it has none.

    Attributes:
        squared: n².
        x: ½·∂n²/∂x, 1/mm.
        y: likewise.
        z: likewise.
    """

    squared: Number
    x: Number
    y: Number
    z: Number


@dataclass(frozen=True)
class Gradient:
    """A medium has an index that changes from place to place.

    n, or its square, is that of a homogeneous medium plus Σ coefficient·term, with r² = x² + y²
    and z counted from the vertex of the surface in front of it, along the surface's axes.

    Attributes:
        base: the homogeneous medium: it gives the index at that vertex.
        terms: names and coefficients, 1/mm to the power of the term.
        squared: whether the terms add to n², and not to n.
    """

    base: Any
    terms: tuple[tuple[str, float], ...]
    squared: bool = False

    @property
    def name(self) -> str:
        """Return the medium as a prescription writes it."""
        words = (f"{term}={value!r}" for term, value in self.terms)
        return " ".join((f"gradient{'_squared' if self.squared else ''}", self.base.name, *words))

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Return the index at the vertex of the surface in front, at a wavelength in nm."""
        return self.base.index(wavelength)

    @cached_property
    def _coefficients(self) -> dict[str, float]:
        return dict(self.terms)

    @cached_property
    def _polynomials(self) -> tuple[tuple[float, ...], ...]:
        """Return the coefficients of r², of z, of x and of y, each up to the last that is given."""
        found = []
        for names in (RADIAL, AXIAL, ACROSS[:2], ACROSS[2:]):
            given = [k for k, name in enumerate(names, 1) if name in self._coefficients]
            found.append(
                tuple(self._coefficients.get(n, 0.0) for n in names[: max(given, default=0)])
            )
        return tuple(found)

    @cached_property
    def coefficients(self) -> tuple[float, ...]:
        """Return the coefficients of all terms, in the order of `TERMS`."""
        return tuple(self._coefficients.get(term, 0.0) for term in TERMS)

    @cached_property
    def axial(self) -> bool:
        """Return whether the index changes along the axis."""
        return any(term in AXIAL for term, _ in self.terms)

    def curvature(self, meridian: str | None) -> float:
        """Return the coefficient of r² in a section `x` or `y`, or in their mean (None), 1/mm²."""
        of = self._coefficients.get
        both = (of("x2", 0.0), of("y2", 0.0))
        across = 0.5 * sum(both) if meridian is None else both["xy".index(meridian)]
        return of("r2", 0.0) + across

    def bend(self, base: Number, x: Number, y: Number, z: Number) -> Bend:
        """Return n² and half of its gradient.

        Args:
            base: index of the homogeneous medium.
            x: mm, from the vertex, along the axes of the surface in front.
            y: likewise.
            z: likewise.
        """
        radial, axial, *across = self._polynomials
        added, slopes = 0.0, [0.0, 0.0, 0.0]
        if radial:
            added, slope = _polynomial(radial, x * x + y * y)
            slope = 2.0 * slope
            slopes[0], slopes[1] = slope * x, slope * y
        if axial:
            value, slopes[2] = _polynomial(axial, z)
            added = added + value
        for place, terms, along in zip((0, 1), across, (x, y), strict=True):
            if terms:
                value, slope = _polynomial(terms, along)
                added, slopes[place] = added + value, slopes[place] + slope
        if self.squared:
            return Bend(base * base + added, *(0.5 * slope for slope in slopes))
        n = base + added
        # No index is negative, and its square would not say so.
        return Bend(n * abs(n), *(n * slope for slope in slopes))


def _polynomial(coefficients: tuple[float, ...], u: Number) -> tuple[Number, Number]:
    """Return Σ c_k·u^k from k = 1, and its derivative."""
    value: Number = coefficients[-1]
    slope: Number = len(coefficients) * value
    for k in range(len(coefficients) - 1, 0, -1):
        value, slope = value * u + coefficients[k - 1], slope * u + k * coefficients[k - 1]
    return value * u, slope


class Motion(NamedTuple):
    """A ray in motion: position (mm), optical direction T, optical path (mm)."""

    x: Number
    y: Number
    z: Number
    tx: Number
    ty: Number
    tz: Number
    path: Number


def carry(
    bend: Callable[[Number, Number, Number], Bend], start: Motion, t: Number, steps: int
) -> Motion:
    """Carry rays on by t = ∫ds/n (mm), in so many steps.

    Args:
        bend: n² and its half gradient at x, y, z.
        start: tensors or numbers of one shape.
        t: of each ray.
        steps: one or more.
    """
    h = t / steps
    motion = _kicked(bend, start, KICKS[0] * h)

    def step(motion: Motion, last: float) -> Motion:
        for drift, kick in zip(DRIFTS, (*KICKS[1:-1], last), strict=True):
            motion = _kicked(bend, _drifted(motion, drift * h), kick * h)
        return motion

    replays = (
        torch.is_grad_enabled()
        and isinstance(motion.x, Tensor)
        and motion.x.numel() >= _MANY
        and not is_transformed()
    )
    for k in range(steps):
        # The last kick of a step and the first of the next are one.
        last = (2.0 if k + 1 < steps else 1.0) * KICKS[0]
        if replays:
            motion = checkpoint(step, motion, last, use_reentrant=False, preserve_rng_state=False)
        else:
            motion = step(motion, last)
    return motion


def _kicked(bend: Callable[[Number, Number, Number], Bend], motion: Motion, k: Number) -> Motion:
    x, y, z, tx, ty, tz, path = motion
    squared, fx, fy, fz = bend(x, y, z)
    return Motion(x, y, z, tx + k * fx, ty + k * fy, tz + k * fz, path + 0.5 * k * squared)


def _drifted(motion: Motion, d: Number) -> Motion:
    x, y, z, tx, ty, tz, path = motion
    path = path + 0.5 * d * (tx * tx + ty * ty + tz * tz)
    return Motion(x + d * tx, y + d * ty, z + d * tz, tx, ty, tz, path)


def steps_through(
    medium: Gradient, base: float, start: float, length: float, radius: float, dtype: torch.dtype
) -> int:
    """Return the steps of a ray through a gap.

    Args:
        medium: in the gap.
        base: index of its homogeneous medium.
        start: z of the gap's beginning, from the vertex that the profile counts from, mm.
        length: along the axis, with its sign, mm.
        radius: of what light passes, mm.
        dtype: precision of the rays.

    The fastest change of direction per t over a grid of points, √|∂(½∇n²)/∂r|, times t along the
    axis is the phase.  Two digits of the lengths count.
    """
    lengths = (float(f"{number:.2g}") for number in (base, start, length, radius))
    return _steps(medium, *lengths, dtype)


@lru_cache(maxsize=1024)
def _steps(
    medium: Gradient, base: float, start: float, length: float, radius: float, dtype: torch.dtype
) -> int:
    fastest, slowest = 0.0, math.inf
    step = 1e-4 * max(radius, abs(length), 1e-6)
    for i in range(_LOOKS):
        z = start + length * i / (_LOOKS - 1)
        for j in range(_LOOKS):
            r = radius * j / (_LOOKS - 1)
            for x, y in ((r, 0.0), (0.0, r), (-r, 0.0), (0.0, -r)):
                here = medium.bend(base, x, y, z)
                if r == 0.0:
                    slowest = min(slowest, max(here.squared, 0.0))
                for dx, dy, dz in ((step, 0.0, 0.0), (0.0, step, 0.0), (0.0, 0.0, step)):
                    there = medium.bend(base, x + dx, y + dy, z + dz)
                    change = math.hypot(*(a - b for a, b in zip(there[1:], here[1:], strict=True)))
                    fastest = max(fastest, change / step)
    phase = math.sqrt(fastest) * (abs(length) + 0.5 * radius) / max(math.sqrt(slowest), 0.3)
    rate, least = _STEPS.get(dtype, _STEPS[torch.float64])
    if not math.isfinite(phase):
        return _MOST_STEPS
    return max(least, min(_MOST_STEPS, math.ceil(rate * phase)))


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
    medium: Gradient, base: Number, start: Number, thickness: Number, meridian: str | None = None
) -> BentGap:
    """Return the paraxial gap of a gradient.

    y'' = κ·y along t with κ = ½·∂²n²/∂y² on the axis; n·u = dy/dt.  Terms in x and y alone, which
    tilt the axis, are left out.

    Args:
        medium: the gradient.
        base: index of its homogeneous medium.
        start: z of the gap's beginning from the vertex that the profile counts from, mm.
        thickness: with its sign, mm.
        meridian: section `x` or `y`; None: the mean.

    Raises:
        InputError: the index is not positive there.
    """

    def index(z: Number) -> Number:
        squared = medium.bend(base, 0.0, 0.0, z).squared
        if not plain(squared) > 0.0:
            raise InputError(
                f"material '{medium.name}': its index is not positive on the axis at "
                f"{plain(z):g} mm"
            )
        return squared**0.5

    way = -1.0 if plain(thickness) < 0.0 else 1.0
    curvature = medium.curvature(meridian)
    behind = index(start + thickness)
    if not medium.axial:
        n = index(0.0)
        kappa = curvature if medium.squared else 2.0 * n * curvature
        return BentGap(*_exponential(kappa, way * thickness / n, curvature), behind)
    nodes, weights = _gauss()
    t = sum(
        w * (way * thickness) / index(start + u * thickness)
        for u, w in zip(nodes, weights, strict=True)
    )

    def bend(y: Number, y2: Number, z: Number) -> Bend:
        here = medium.bend(base, 0.0, 0.0, z)
        kappa = curvature if medium.squared else 2.0 * abs(here.squared) ** 0.5 * curvature
        return Bend(0.0, kappa * y, kappa * y2, here.z)

    begin = Motion(1.0, 0.0, start, 0.0, 1.0, way * index(start), 0.0)
    lengths = (plain(start), plain(thickness))
    steps = steps_through(medium, plain(base), *lengths, 1e-3 * abs(lengths[1]), torch.float64)
    end = carry(bend, begin, t, steps)
    return BentGap(end.x, end.y, end.tx, end.ty, behind)


def gap_of_gradient(
    thicknesses: Sequence[Number], origin: int, place: int
) -> tuple[Number, Number]:
    """Return where a gap begins, from the vertex that its profile counts from, and its length, mm.

    Args:
        thicknesses: of all gaps.
        origin: number of the surface that the profile counts from.
        place: of the medium.
    """
    return sum(thicknesses[origin - 1 : place - 1], 0.0), thicknesses[place - 1]


def paraxial_gaps(
    thicknesses: Sequence[Number],
    materials: Sequence[Any],
    places: Mapping[int, int],
    indices: Sequence[Number],
    senses: Sequence[float],
    meridian: str | None = None,
) -> list[Any]:
    """Return gaps as paraxial rays take them: lengths, and `BentGap` of gradients.

    Args:
        thicknesses: of all gaps, mm.
        materials: of all media.
        places: of gradients, and the surfaces that their profiles count from.
        indices: of these alone, negative where light travels towards -z.
        senses: +1 where light travels towards +z, -1 towards -z; of all media.
        meridian: section `x` or `y`; None: the mean.
    """
    gaps = list(thicknesses)
    for (place, origin), signed in zip(places.items(), indices, strict=True):
        sense = senses[place]
        start, length = gap_of_gradient(thicknesses, origin, place)
        gap = bent_gap(materials[place], sense * signed, start, length, meridian)
        gaps[place - 1] = gap._replace(behind=sense * gap.behind)
    return gaps


def plain(value: Number) -> float:
    """Return a number without a graph, of several the mean, as it is beneath transforms."""
    if not isinstance(value, Tensor):
        return float(value)
    return torch.func.debug_unwrap(value.detach(), recurse=True).double().mean().item()


def _exponential(kappa: Number, t: Number, sign: float) -> tuple[Number, Number, Number, Number]:
    """Return the matrix of y'' = κ·y over t; κ has this sign."""
    if sign == 0.0:
        return 1.0, t, 0.0, 1.0
    rate = (kappa if sign > 0.0 else -kappa) ** 0.5
    phase = rate * t
    library: Any = torch if isinstance(phase, Tensor) else math
    cosine, sine = (
        (library.cosh(phase), library.sinh(phase))
        if sign > 0.0
        else (library.cos(phase), library.sin(phase))
    )
    return cosine, sine / rate, (1.0 if sign > 0.0 else -1.0) * rate * sine, cosine
