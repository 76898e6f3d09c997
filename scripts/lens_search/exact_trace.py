"""The same rays in 80 digits: a second tracer, which shares nothing with the plain one.

Surfaces are spheres, conics and even aspheres on one axis.  A ray starts in the plane of a paraxial
entrance pupil, or is aimed at the stop's own rim by Newton's method.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpmath import mp, mpf
from numpy.typing import NDArray

from lens_search.plain_lens import PlainLens, entrance_pupil
from lens_search.plain_trace import PupilRays

mp.dps = 80
Triple = tuple[mpf, mpf, mpf]
_SMALL = mp.mpf(10) ** -70
_STEP = mp.mpf(10) ** -30
# At which the first crossing of an asphere is looked for.
_SAMPLES = 1001


@dataclass(frozen=True)
class Ray:
    """Where a ray meets the image plane and each surface, mm; and its path to each surface."""

    x: mpf
    y: mpf
    points: list[tuple[mpf, mpf]]
    paths: list[mpf]


class Fails(ArithmeticError):
    """A ray misses a surface, or is totally reflected."""


class ExactLens:
    """A lens in 80 digits at one wavelength.

    Args:
        lens: as read.
        wavelength: nm.
    """

    def __init__(self, lens: PlainLens, wavelength: float) -> None:
        self.lens = lens
        self.curvature = [mp.mpf(row.curvature) for row in lens.rows]
        self.conic = [mp.mpf(row.conic) for row in lens.rows]
        self.terms = [{p: mp.mpf(a) for p, a in row.terms.items() if a} for row in lens.rows]
        self.gap = [mp.mpf(row.gap) for row in lens.rows]
        self.index = [mp.mpf(n) for n in lens.indices(wavelength)]
        pupil = entrance_pupil(lens, mp.mpf)
        self.pupil, self.diameter, self.focal_length, self.back_focus, self.scale = pupil

    def sag(self, k: int, squared: mpf) -> tuple[mpf, mpf]:
        """Return the sag at a squared height, and its derivative with respect to it."""
        c, terms = self.curvature[k], self.terms[k]
        inside = 1 - (1 + self.conic[k]) * c * c * squared
        if inside <= 0:
            raise Fails
        root = mp.sqrt(inside)
        value, slope = c * squared / (1 + root), c / (2 * root)
        for power, a in terms.items():
            value += a * squared ** (power // 2)
            slope += a * (power // 2) * squared ** (power // 2 - 1)
        return value, slope

    def _meet(self, k: int, point: Triple, direction: Triple) -> mpf:
        """Return the path from a point to surface k."""
        x, y, z = point
        dx, dy, dz = direction
        c, one = self.curvature[k], 1 + self.conic[k]
        along = dz - c * (x * dx + y * dy + one * z * dz)
        across = c * (x * x + y * y + one * z * z) - 2 * z
        squared = along * along - c * (1 + self.conic[k] * dz * dz) * across
        if squared <= 0 or along + mp.sqrt(squared) <= 0:
            raise Fails
        return across / (along + mp.sqrt(squared))

    def _meet_asphere(self, k: int, point: Triple, direction: Triple) -> mpf:
        """Return the path from a point to the first crossing of an asphere within its edge; to one
        near its conic where it has no edge.
        """
        dx, dy, dz = direction
        if math.isfinite(self.lens.rows[k].edge):
            far = mp.mpf(self._first_crossing(k, point, direction))
        else:
            far = self._meet(k, point, direction)
        for _ in range(100):
            at = [p + far * d for p, d in zip(point, direction, strict=True)]
            value, slope = self.sag(k, at[0] ** 2 + at[1] ** 2)
            step = (at[2] - value) / (dz - 2 * slope * (at[0] * dx + at[1] * dy))
            far -= step
            if abs(step) < _SMALL:
                return far
        raise Fails

    def _first_crossing(self, k: int, point: Triple, direction: Triple) -> float:
        """Return the path to the first crossing nearly: a polynomial can have several."""
        c, one = float(self.curvature[k]), 1.0 + float(self.conic[k])

        def sag(r: NDArray[np.float64]) -> NDArray[np.float64]:
            root = np.sqrt(np.maximum(1.0 - one * (c * r) ** 2, 0.0))
            terms = (float(a) * r**power for power, a in self.terms[k].items())
            return c * r**2 / (1.0 + root) + sum(terms)

        edge = self.lens.rows[k].edge
        sags = sag(np.linspace(0.0, edge, _SAMPLES))
        x, y, z = map(float, point)
        dx, dy, dz = map(float, direction)
        room = 1e-3 * edge
        far = np.linspace(sags.min() - room - z, sags.max() + room - z, _SAMPLES) / dz
        radius = np.hypot(x + far * dx, y + far * dy)
        above = np.where(radius < edge, z + far * dz - sag(radius), np.nan)
        (found,) = np.nonzero((above[:-1] <= 0.0) & (above[1:] > 0.0))
        if not len(found):
            raise Fails
        return float(far[found[0]])

    def trace(self, point: Triple, direction: Triple, last: int | None = None) -> Ray:
        """Trace a ray, to surface `last` alone where it is given.

        Args:
            point: three numbers from the first vertex, mm.
            direction: three numbers, a unit vector.
            last: place of a surface.

        Raises:
            Fails: it misses a surface, or is totally reflected.
        """
        before, points, paths = mp.mpf(1), [], []
        for k, index in enumerate(self.index):
            meet = self._meet_asphere if self.terms[k] else self._meet
            far = meet(k, point, direction)
            x, y, z = (p + far * d for p, d in zip(point, direction, strict=True))
            points.append((x, y))
            paths.append(far)
            if k == last:
                return Ray(x, y, points, paths)
            _, slope = self.sag(k, x * x + y * y)
            normal = (-2 * slope * x, -2 * slope * y, mp.mpf(1))
            size = mp.sqrt(normal[0] ** 2 + normal[1] ** 2 + 1)
            cosine = sum(n * d for n, d in zip(normal, direction, strict=True)) / size
            ratio = before / index
            bent = 1 - ratio**2 * (1 - cosine**2)
            if bent <= 0 or cosine <= 0:
                raise Fails
            turn = (mp.sqrt(bent) - ratio * cosine) / size
            direction = tuple(ratio * d + turn * n for n, d in zip(normal, direction, strict=True))
            before = index
            point = (x, y, z - self.gap[k])
        far = -point[2] / direction[2]
        return Ray(point[0] + far * direction[0], point[1] + far * direction[1], points, paths)

    def through_pupil(self, angle: float, px: float, py: float) -> Ray:
        """Trace the ray of a field (degrees) through a point of the paraxial entrance pupil."""
        radius = self.diameter / 2
        return self.trace((radius * px, radius * py, self.pupil), _direction(angle))

    def through_stop(self, angle: float, px: float, py: float) -> Ray:
        """Trace the ray of a field that meets the stop at a part of its radius."""
        radius = abs(self.diameter / 2 * self.scale)
        stop, direction = self.lens.stop, _direction(angle)
        sign = mp.sign(self.scale)
        wanted = (radius * px * sign, radius * py * sign)
        start = [self.diameter / 2 * px, self.diameter / 2 * py]

        def miss(at: Sequence[mpf]) -> tuple[mpf, mpf]:
            met = self.trace((at[0], at[1], self.pupil), direction, stop)
            return met.x - wanted[0], met.y - wanted[1]

        for _ in range(60):
            off = miss(start)
            if max(abs(off[0]), abs(off[1])) < _SMALL:
                return self.trace((start[0], start[1], self.pupil), direction)
            ax = miss((start[0] + _STEP, start[1]))
            ay = miss((start[0], start[1] + _STEP))
            a, b = (ax[0] - off[0]) / _STEP, (ay[0] - off[0]) / _STEP
            c, d = (ax[1] - off[1]) / _STEP, (ay[1] - off[1]) / _STEP
            det = a * d - b * c
            start[0] -= (d * off[0] - b * off[1]) / det
            start[1] -= (a * off[1] - c * off[0]) / det
        raise Fails


def _direction(angle: float) -> Triple:
    radians = mp.radians(mp.mpf(angle))
    return mp.mpf(0), mp.sin(radians), mp.cos(radians)


@dataclass(frozen=True)
class ExactSpots:
    """Spots in 80 digits.

    Attributes:
        rms: of each field about its centroid over all wavelengths, µm.
        chief: height of each field's chief ray at the reference wavelength, mm.
        height: the farthest ray from the axis on each surface, mm.
        shortest: the least path to each surface from the one before, mm.
        failed: rays that do not pass; they are left out.
    """

    rms: list[mpf]
    chief: list[mpf]
    height: list[mpf]
    shortest: list[mpf]
    failed: int


def spots(lens: PlainLens, rays: PupilRays, aimed: bool = False) -> ExactSpots:
    """Trace the spots of a lens.

    Args:
        lens: as read.
        rays: of each field, over half of the pupil.
        aimed: whether they are aimed at the stop; else through the paraxial entrance pupil.
    """
    exact = [ExactLens(lens, wavelength) for wavelength in lens.wavelengths]
    main = lens.wavelengths.index(lens.reference) if lens.reference in lens.wavelengths else 0
    count = len(lens.rows)
    height, shortest = [mp.mpf(0)] * count, [mp.inf] * count
    rms, chief, failed = [], [], 0
    for angle in lens.angles:
        found, middle = [], mp.nan
        for place, (at, share) in enumerate(zip(exact, lens.weights, strict=True)):
            shoot = at.through_stop if aimed else at.through_pupil
            for k, (px, py, weight) in enumerate(zip(rays.x, rays.y, rays.weight, strict=True)):
                try:
                    ray = shoot(angle, float(px), float(py))
                except (Fails, ZeroDivisionError):
                    failed += 1
                    continue
                if k == rays.chief and place == main:
                    middle = ray.y
                found.append((ray.x, ray.y, mp.mpf(float(weight)) * mp.mpf(share)))
                radii = [mp.hypot(*p) for p in ray.points]
                height = [max(h, r) for h, r in zip(height, radii, strict=True)]
                shortest = [min(s, p) for s, p in zip(shortest, ray.paths, strict=True)]
        rms.append(_rms_um(found))
        chief.append(middle)
    return ExactSpots(rms, chief, height, shortest, failed)


def _rms_um(points: Sequence[Triple]) -> mpf:
    total = mp.fsum(w for *_, w in points)
    if total == 0:
        return mp.nan
    mean = mp.fsum(y * w for _, y, w in points) / total
    return 1000 * mp.sqrt(mp.fsum((x * x + (y - mean) ** 2) * w for x, y, w in points) / total)
