"""Sags and slopes of the surfaces of many lenses carry their derivatives along.

Lengths are in units of the focal length.  A sphere has the sag h·ch/(1 + √(1 - c²h²)) at the
height h, an asphere c·h²/2 + a4·h⁴ + a6·h⁶ + ….
"""

from collections.abc import Sequence

import torch

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.paraxial import LensNumbers
from dolens.lens_search.tangents import Tangents

# Beyond this part of a hemisphere the sag is continued along its tangent, to stay finite.
_STEEP = 0.98


def sags(
    arrangement: Arrangement, lenses: LensNumbers, surfaces: Sequence[int], heights: Tangents
) -> Tangents:
    """Return the sags of n surfaces at a height each.

    Args:
        arrangement: of the lenses.
        lenses: whose curvatures and coefficients are the variables themselves.
        surfaces: n numbers, from 0.
        heights: (n, 1 + P, L).
    """
    curvatures = Tangents.stacked([lenses.curvatures[n] for n in surfaces])
    rows = [n for n, surface in enumerate(surfaces) if arrangement.is_asphere(surface)]
    if not rows:
        return sphere_sags(curvatures, heights)
    if len(rows) == len(surfaces):
        return _polynomials(arrangement, lenses, surfaces, heights, slopes=False)
    others = [n for n in range(len(surfaces)) if n not in rows]
    found = torch.empty_like(heights.rows)
    found[others] = sphere_sags(curvatures[others], heights[others]).rows
    of_rows = [surfaces[n] for n in rows]
    found[rows] = _polynomials(arrangement, lenses, of_rows, heights[rows], slopes=False).rows
    return Tangents(found)


def asphere_slopes(
    arrangement: Arrangement, lenses: LensNumbers, surfaces: Sequence[int], heights: Tangents
) -> Tangents:
    """Return dz/dh of n aspheres at a height each; arguments as those of `sags`."""
    return _polynomials(arrangement, lenses, surfaces, heights, slopes=True)


def sphere_sags(curvature: Tangents, height: Tangents) -> Tangents:
    """Return the sags of spheres; beyond their steep part those of the tangent there."""
    steep = curvature * height
    inside = steep.clamp(-_STEEP, _STEEP)
    root = (1.0 - inside * inside).sqrt()
    sag = inside / (root + 1.0)
    beyond = steep - inside
    if bool((beyond.value != 0.0).any()):
        slope = 1.0 / (root.value * (1.0 + root.value))
        sag = sag + beyond * slope
    return height * sag


def _polynomials(
    arrangement: Arrangement,
    lenses: LensNumbers,
    surfaces: Sequence[int],
    heights: Tangents,
    slopes: bool,
) -> Tangents:
    """Return the sags of aspheres, or their slopes.

    Each is Σ b·v·h^q over the variables v of its surface, so that its derivatives are b·h^q with
    respect to these, and Σ q·b·v·h^(q-1) times those of the height.
    """
    h = heights.value
    known = sorted(set(surfaces))
    terms = max(len(lenses.coefficients[n]) for n in known)
    numbers = torch.zeros((len(known), 1 + terms, h.shape[-1]), dtype=h.dtype)
    for row, n in enumerate(known):
        for term, number in enumerate((lenses.curvatures[n], *lenses.coefficients[n])):
            numbers[row, term] = number.value
    numbers = numbers[[known.index(n) for n in surfaces]]
    # Orders q = 2, 4, ... of sags, and 1, 3, ... of slopes.
    order = torch.arange(2.0, 2.0 * terms + 3.0, 2.0, dtype=h.dtype)
    factor = torch.ones_like(order)
    factor[0] = 0.5
    if slopes:
        factor, order = factor * order, order - 1.0
    first = torch.ones_like(h) if slopes else h
    squares = (h * h)[:, None].expand(-1, terms, -1)
    lower = torch.cat([first[:, None], squares], 1).cumprod(1)  # h^(q-1)
    lower = lower * factor[:, None]
    partial = lower * h[:, None]
    rows = heights.rows * (lower * numbers * order[:, None]).sum(1)[:, None]
    rows[:, 0] = (partial * numbers).sum(1)
    places = [
        (row, 1 + column, term)
        for row, n in enumerate(surfaces)
        for term, column in enumerate((n, *arrangement.coefficient_columns[n]))
    ]
    at, columns, which = (torch.tensor(place) for place in zip(*places, strict=True))
    rows[at, columns] += partial[at, which]
    return Tangents(rows)
