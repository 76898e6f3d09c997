"""The task of a search in plain numbers: bounds, rays and limits, without dolens.

`search_by_others.py` writes them as JSON.  Variables are those of the search in mm: curvatures,
gaps between neighbours of the sequence (refracting surfaces, and the stop as -1), the distance from
the last of it to the sensor, and the coefficients of aspheres.  Deviations are those of
`dolens.lens_search.operands`, with the real heights of beams for paraxial ones: over the focal
length, or relative.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STOP = -1
# Shares of the beam's height at which aspheres, and the spaces beside them, are looked at.
_ZONES = np.array([0.35, 0.55, 0.7, 0.8, 0.9, 0.95, 1.0])
# What limits of spaces, distortion and chief-ray angles have in reserve: spheres, and aspheres.
_RESERVE, _WITHIN = (0.0002, 0.002), (0.999, 0.985)
# Beyond this part of a hemisphere the sag is continued along its tangent.
_STEEP = 0.98


@dataclass(frozen=True)
class Lens:
    """One lens in mm: curvatures (S,), gaps (G,), the sensor's distance, and coefficients."""

    curvatures: Array
    gaps: Array
    image: float
    coefficients: tuple[Array, ...]

    def sag(self, surface: int, height: Array) -> Array:
        """Return the sags of a surface: an asphere's where it has coefficients."""
        own, h = self.coefficients[surface], np.asarray(height)
        c = self.curvatures[surface]
        if own.size:
            powers = 2.0 * np.arange(2, own.size + 2)
            return 0.5 * c * h * h + (own * h[..., None] ** powers).sum(-1)
        inside = np.clip(c * h, -_STEEP, _STEEP)
        root = np.sqrt(1.0 - inside * inside)
        return h * (inside / (1.0 + root) + (c * h - inside) / (root * (1.0 + root)))

    def slope(self, surface: int, height: Array) -> Array:
        """Return the slopes dz/dh of an asphere."""
        own, h = self.coefficients[surface], np.asarray(height)
        powers = 2.0 * np.arange(2, own.size + 2)
        return self.curvatures[surface] * h + (powers * own * h[..., None] ** (powers - 1)).sum(-1)


@dataclass(frozen=True)
class Beams:
    """What real rays say of a lens.

    Attributes:
        focal_length: mm.
        heights: of the beam on each refracting surface, mm, (S,).
        opening: radius of the axial beam at the stop, mm.
        chief: heights of the chief rays at the sensor, mm, (C,).
        sines: of their angles there, (C,).
    """

    focal_length: float
    heights: Array
    opening: float
    chief: Array
    sines: Array


@dataclass(frozen=True)
class PlainTask:
    """A task as `search_by_others.py` writes it; `data` is what the JSON holds."""

    data: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        """Return a number or a list of the data."""
        try:
            return self.__dict__["data"][name]
        except KeyError:
            raise AttributeError(name) from None

    @cached_property
    def bounds(self) -> Array:
        """Return the least and greatest values, (2, P)."""
        return np.array([self.lower, self.upper])

    @property
    def surfaces(self) -> int:
        """Return the number of refracting surfaces."""
        return len(self.in_glass)

    def lens(self, values: Array) -> Lens:
        """Return the lens of values (P,)."""
        s, g = self.surfaces, len(self.sequence) - 1
        ends = np.cumsum(self.terms)[:-1]
        coefficients = np.split(np.asarray(values[s + g + 1 :]), ends)
        return Lens(values[:s], values[s : s + g], float(values[s + g]), tuple(coefficients))

    def paraxial(self, lens: Lens) -> tuple[float, float]:
        """Return the focal length and the distance of the entrance pupil from the first of the
        sequence, mm (Welford, ch. 3).
        """
        # Heights and n·u of two rays: parallel to the axis, and through the first vertex.
        y, nu, before, pupil = np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0, 0.0
        for place, number in enumerate(self.sequence):
            behind = self.indices[place][self.reference] if place < len(self.indices) else 1.0
            if number == STOP:
                pupil = y[1] / y[0] if y[0] else np.inf
            else:
                nu = nu - y * lens.curvatures[number] * (behind - before)
            if place < len(lens.gaps):
                y = y + lens.gaps[place] * nu / behind
            before = behind
        return -1.0 / (nu[0] or 1e-12), float(pupil)

    def deviations(self, lens: Lens, beams: Beams) -> Array:
        """Return by how much the focal length and the limits fail; zero where a limit holds."""
        f, limits, wavy = self.focal_length, self.limits, any(self.terms)
        over = []
        if limits["track"] is not None:
            over.append([(lens.gaps.sum() + lens.image - limits["track"]) / f])
        for n in range(self.surfaces):
            if self.terms[n]:
                slopes = np.abs(lens.slope(n, _ZONES * beams.heights[n]))
                over.append(slopes / np.tan(np.radians(limits["slope"])) - 1.0)
            else:
                steep = abs(lens.curvatures[n]) * beams.heights[n]
                over.append([steep - limits["aperture_over_radius"]])
        over += [self._edge(lens, beams.heights, n) for n in range(self.surfaces - 1)]
        over.append(self._about_the_stop(lens, beams.opening))
        last = self.surfaces - 1
        if self.terms[last]:
            room = lens.image - lens.sag(last, _ZONES * beams.heights[last])
            over.append(limits["back_focus"] / f + _RESERVE[1] - room / f)
        if limits["distortion"] is not None:
            share = beams.chief / (f * np.array(self.chief_tangents)) - 1.0
            over.append(np.abs(share) - _WITHIN[wavy] * limits["distortion"])
        if limits["chief_ray_angle"] is not None:
            most = np.sin(np.radians(_WITHIN[0] * limits["chief_ray_angle"]))
            over.append(np.abs(beams.sines) - most)
        broken = np.maximum(np.concatenate([np.atleast_1d(part) for part in over]), 0.0)
        return np.concatenate([[f / beams.focal_length - 1.0], broken])

    def _edge(self, lens: Lens, heights: Array, n: int) -> Array:
        """Return by how much the space behind surface n is too thin, over f."""
        wavy, glass, limits = any(self.terms), self.in_glass[n], self.limits
        at = self.sequence.index(n)
        thickness = lens.gaps[at : self.sequence.index(n + 1)].sum()
        own, other = heights[n], heights[n + 1]
        if wavy:
            edges = [max(heights[k] for k in self._group(m)) for m in (n, n + 1)]
            every = _ZONES * (edges[0] if glass else min(edges))
            own, other = np.minimum(every, own), np.minimum(every, other)
        elif not glass:
            own = other = max(own, other)
        room = thickness + lens.sag(n + 1, other) - lens.sag(n, own)
        least = limits["glass_edge" if glass else "air_edge"]
        return np.atleast_1d((least - room) / self.focal_length + _RESERVE[wavy])

    def _group(self, n: int) -> range:
        """Return the surfaces of the element, or cemented group, that surface n is of."""
        first = last = n
        while first and self.in_glass[first - 1]:
            first -= 1
        while self.in_glass[last]:
            last += 1
        return range(first, last + 1)

    def _about_the_stop(self, lens: Lens, opening: float) -> Array:
        """Return by how much spaces about the stop are too long, or too near to its rim, over f."""
        f, limits, at = self.focal_length, self.limits, self.sequence.index(STOP)
        over = []
        if limits["air"][1] is not None and 0 < at < len(self.sequence) - 1:
            over.append(lens.gaps[at - 1] + lens.gaps[at] - limits["air"][1])
        for neighbour, side in ((at - 1, -1.0), (at + 1, 1.0)):
            if 0 <= neighbour < len(self.sequence):
                sag = float(lens.sag(self.sequence[neighbour], np.array(opening)))
                over.append(limits["air_edge"] - lens.gaps[min(neighbour, at)] - side * sag)
        return np.array(over) / f
