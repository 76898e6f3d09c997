"""Sags and slopes of the surfaces of many lenses carry their derivatives along.

Lengths are in units of the focal length.  A sphere has the sag h·ch/(1 + √(1 - c²h²)) at the
height h, an asphere c·h²/2 + a4·h⁴ + a6·h⁶ + ….
"""

from collections.abc import Sequence

import torch
from torch import Tensor

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
    value, of_height = torch.zeros_like(h), torch.zeros_like(h)
    places: list[tuple[int, int]] = []
    partials: list[Tensor] = []
    for row, surface in enumerate(surfaces):
        columns = [surface, *arrangement.coefficient_columns[surface]]
        numbers = [lenses.curvatures[surface], *lenses.coefficients[surface]]
        power = torch.ones_like(h[row])
        square = h[row] * h[row]
        # power = h^(q-1), of sags q = 2, 4, ...; of slopes q = 1, 3, ...
        if not slopes:
            power = h[row]
        for order, (column, number) in enumerate(zip(columns, numbers, strict=True), 1):
            q = 2 * order - (1 if slopes else 0)
            factor = 0.5 if order == 1 else 1.0
            if slopes:
                factor *= 2.0 * order
            term = factor * power
            of_height[row] += q * term * number.value
            term = term * h[row]
            value[row] += term * number.value
            places.append((row, 1 + column))
            partials.append(term)
            power = power * square
    rows = heights.rows * of_height[:, None, :]
    rows[:, 0] = value
    at = tuple(torch.tensor(place) for place in zip(*places, strict=True))
    rows[at] += torch.stack(partials)
    return Tangents(rows)
