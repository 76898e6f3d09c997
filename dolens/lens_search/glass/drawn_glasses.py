"""Starts of a search draw real glasses.

Any glass may stand anywhere.  Of the cemented pairs most are drawn among those that make a thin
achromat of moderate curvatures, with the curvatures of one: two random glasses seldom do.
"""

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from dolens.lens_search.glass.glass_set import GlassSet
from dolens.lens_search.glass.thin_achromats import thin_achromats

# Greatest Σ|κ| of a thin achromat of focal length 1; N-BK7 with F2 has 6.6.
_MOST_STRENGTH = 8.0
# Of cemented pairs, those that are achromats.
_SHARE = 0.7
# Greatest power of such a pair, over that of the lens, either way.
_MOST_POWER = 2.5


def drawn_glasses(
    glasses: GlassSet, groups: Sequence[int], curvatures: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return the numbers of the glasses of L lenses, (L, G), int64, and their curvatures (L, S).

    Args:
        glasses: with indices at their wavelengths.
        groups: elements of each cemented group.
        curvatures: (L, S), times the focal length; those of achromats follow from the first.
        generator: of the random numbers.
    """
    count, curvatures = len(curvatures), curvatures.clone()
    numbers = torch.randint(len(glasses.names), (count, sum(groups)), generator=generator)
    pairs, total = _achromats(glasses)
    element = surface = 0
    for elements in groups:
        if elements == 2 and len(pairs):
            drawn = torch.randint(len(pairs), (count,), generator=generator)
            chosen = (torch.rand(count, generator=generator) < _SHARE)[:, None]
            power = _MOST_POWER * (2.0 * torch.rand(count, 1, generator=generator) - 1.0)
            here = slice(element, element + 2)
            numbers[:, here] = torch.where(chosen, pairs[drawn], numbers[:, here])
            first = curvatures[:, surface : surface + 1]
            bent = first - (power.to(total) * total[drawn]).cumsum(1)
            behind = slice(surface + 1, surface + 3)
            curvatures[:, behind] = torch.where(chosen, bent, curvatures[:, behind])
        element, surface = element + elements, surface + elements + 1
    return numbers, curvatures


@lru_cache(maxsize=8)
def _achromats(glasses: GlassSet) -> tuple[Tensor, Tensor]:
    """Return the pairs of glasses of thin achromats in both orders, (n, 2), and the total
    curvatures of their elements for a power of one, (n, 2).
    """
    waves = torch.tensor(glasses.basis.wavelengths)
    if len(waves) < 3:
        return torch.zeros((0, 2), dtype=torch.int64), torch.zeros((0, 2), dtype=torch.float64)
    order = waves.argsort()
    indices = glasses.indices[:, [order[0], order[len(order) // 2], order[-1]]]
    pairs = torch.combinations(torch.arange(len(indices)), 2)
    found = thin_achromats(indices, pairs)
    weak = found.take(found.strength <= _MOST_STRENGTH)
    total = weak.total_curvatures
    return torch.cat([weak.glasses, weak.glasses.flip(1)]), torch.cat([total, total.flip(1)])
