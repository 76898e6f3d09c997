"""Pairs of glasses as thin achromatic doublets of focal length 1, in closed form.

Two thin elements in contact, of total curvatures κ (the difference of their two surfaces'), have
the power Σ κ (n - 1).  That it is 1 at the middle wavelength, and the same at the short and the
long one, fixes both:

    κ₁ (n₁ - 1) = V₁/(V₁ - V₂),   κ₂ (n₂ - 1) = -V₂/(V₁ - V₂).

The focus of the two outer wavelengths then lies behind that of the middle one by the secondary
spectrum, -(P₁ - P₂)/(V₁ - V₂) with P = (n_short - n_middle)/(n_short - n_long): about 1/2000 for
glasses on the normal line, N-BK7 with F2 for example.

One curvature is left to a cemented doublet, its bending.  The spherical aberration is quadratic in
it, and the curvatures here are those of the zero with the smaller coma, or of the least where there
is no zero.  With these held, the sums at the outer wavelengths give the spherochromatism (Welford,
Aberrations of Optical Systems, 1986, chapters 8 to 12).

Starts of a search draw real glasses.

Any glass may stand anywhere.  Of the cemented pairs most are drawn among those that make a thin
achromat of moderate curvatures, with the curvatures of one: two random glasses seldom do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.glass.choice import GlassSet


@dataclass(frozen=True)
class ThinAchromats:
    """P cemented thin doublets of focal length 1 for an object at infinity, their stop at the lens.

    The sums are those of a marginal ray at height 1 and of a chief ray with slope 1.

    Attributes:
        glasses: (P, 2), the numbers of the first and of the second glass.
        total_curvatures: (P, 2), κ of the elements.
        powers: (P, 2), at the middle wavelength.
        secondary_spectrum: (P,), from the middle wavelength's focus to that of the outer two.
        curvatures: (P, 3).
        spherical: (P, 3), S_I at the short, the middle and the long wavelength.
        coma: (P,), S_II at the middle wavelength.
        petzval: (P,), Σ power/n at the middle wavelength.
    """

    glasses: Tensor
    total_curvatures: Tensor
    powers: Tensor
    secondary_spectrum: Tensor
    curvatures: Tensor
    spherical: Tensor
    coma: Tensor
    petzval: Tensor

    @property
    def strength(self) -> Tensor:
        """Return Σ|κ|, (P,): how strongly the elements are curved for their common power."""
        return self.total_curvatures.abs().sum(1)

    def wavefront_error(self, focal_length: float, f_number: float) -> Tensor:
        """Return the rms wavefront error on the axis over the three wavelengths, mm, (P,).

        The secondary spectrum is a defocus, Δz/(8 N²) at the edge, and spherical aberration is
        S_I/8 there, each with its best focus (Mahajan, Optical Imaging and Aberrations): the third
        order, without the zones that a strongly curved doublet has besides.
        """
        foci = self.secondary_spectrum[:, None] * torch.tensor([1.0, 0.0, 1.0]).to(self.spherical)
        defocus = focal_length * (foci - foci.mean(1, keepdim=True)) / (8.0 * f_number**2)
        edge = focal_length * self.spherical / (8.0 * (2.0 * f_number) ** 4)
        square = (defocus**2 / 12.0 + edge**2 / 180.0).mean(1)
        return square.sqrt()

    def take(self, chosen: Tensor) -> "ThinAchromats":
        """Return some of the doublets."""
        return ThinAchromats(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def thin_achromats(indices: Tensor, pairs: Tensor) -> ThinAchromats:
    """Return the achromats of pairs of glasses.

    Args:
        indices: (K, 3), of K glasses at a short, a middle and a long wavelength.
        pairs: (P, 2), numbers of glasses; the first faces the object.

    Raises:
        InputError: there are not three wavelengths.
    """
    if indices.shape[-1] != 3:
        raise InputError("an achromat needs indices at a short, a middle and a long wavelength")
    n = indices[pairs]
    middle = n[..., 1] - 1.0
    spread = n[..., 0] - n[..., 2]
    # Σ κ middle = 1 and Σ κ spread = 0; glasses of one Vd have no solution (inf).
    determinant = middle[:, 0] * spread[:, 1] - middle[:, 1] * spread[:, 0]
    kappa = torch.stack([spread[:, 1], -spread[:, 0]], dim=1) / determinant[:, None]
    power = 1.0 + (kappa * (n[..., 0] - n[..., 1])).sum(1)
    curvatures = _cemented(n[..., 1], kappa)
    sums = [_seidel(n[..., w], curvatures) for w in range(3)]
    return ThinAchromats(
        glasses=pairs,
        total_curvatures=kappa,
        powers=kappa * middle,
        secondary_spectrum=1.0 / power - 1.0,
        curvatures=curvatures,
        spherical=torch.stack([spherical for spherical, _ in sums], dim=1),
        coma=sums[1][1],
        petzval=(kappa * middle / n[..., 1]).sum(1),
    )


def best_achromats(
    indices: Tensor,
    focal_length: float,
    f_number: float,
    count: int,
    most_strength: float = 8.0,
    cost: Tensor | None = None,
) -> ThinAchromats:
    """Return the pairs of a set with the smallest wavefront error, the best first.

    Both orders of the glasses are tried, and the better one is kept.

    Args:
        indices: (K, 3), see `thin_achromats`.
        focal_length: mm.
        f_number: focal length over diameter.
        count: of pairs at most.
        most_strength: greatest Σ|κ|; N-BK7 with F2 has 6.6.
        cost: (K,), added to the wavefront error in mm for each glass.

    Raises:
        InputError: a number is not positive, or no pair is weak enough.
    """
    if not (focal_length > 0.0 and f_number > 0.0 and count > 0 and most_strength > 0.0):
        raise InputError("focal length, F-number, count and strength of achromats must be positive")
    pairs = torch.combinations(torch.arange(len(indices), device=indices.device), 2)
    first = thin_achromats(indices, pairs)
    first = first.take((first.strength <= most_strength).nonzero()[:, 0])
    if len(first.glasses) == 0:
        raise InputError(f"no pair of these glasses has a strength of {most_strength:g} or less")
    orders = (first, thin_achromats(indices, first.glasses.flip(1)))
    errors = torch.stack([o.wavefront_error(focal_length, f_number) for o in orders])
    if cost is not None:
        errors = errors + cost[first.glasses].sum(1)
    turned = errors.argmin(0) == 1
    ranked = errors.amin(0).argsort(stable=True)[:count]
    glasses = torch.where(turned[:, None], first.glasses.flip(1), first.glasses)[ranked]
    return thin_achromats(indices, glasses)


def _cemented(n: Tensor, kappa: Tensor) -> Tensor:
    """Return the three curvatures, (P, 3), of doublets with indices and total curvatures (P, 2)."""

    def bent(cement: Tensor) -> Tensor:
        return torch.stack([cement + kappa[:, 0], cement, cement - kappa[:, 1]], dim=1)

    one = torch.ones_like(kappa[:, 0])
    low, zero, high = (_seidel(n, bent(at * one))[0] for at in (-1.0, 0.0, 1.0))
    # S_I = a c² + b c + zero.
    a, b = (high + low) / 2.0 - zero, (high - low) / 2.0
    half = (b**2 - 4.0 * a * zero).clamp(min=0.0).sqrt() / (2.0 * a)
    roots = [bent(-b / (2.0 * a) + sign * half) for sign in (-1.0, 1.0)]
    comas = [_seidel(n, root)[1].abs() for root in roots]
    return torch.where((comas[0] <= comas[1])[:, None], roots[0], roots[1])


def _seidel(n: Tensor, curvatures: Tensor) -> tuple[Tensor, Tensor]:
    """Return S_I and S_II, (P,), of cemented thin doublets with indices (P, 2)."""
    one = torch.ones_like(n[:, 0])
    media = [one, n[:, 0], n[:, 1], one]
    spherical, coma = torch.zeros_like(one), torch.zeros_like(one)
    slope = torch.zeros_like(one)
    for surface in range(3):
        before, behind, c = media[surface], media[surface + 1], curvatures[:, surface]
        invariant = before * (slope + c)
        after = (before * slope - c * (behind - before)) / behind
        change = after / behind - slope / before
        spherical = spherical - invariant**2 * change
        # The chief ray crosses all surfaces at height 0: its invariant is its slope in air.
        coma = coma - invariant * change
        slope = after
    return spherical, coma


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
