"""Zernike polynomials are fitted to a wavefront over a pupil of any outline.

The fit is by least squares over the light that passes, so that vignetted and obscured pupils have
coefficients too.  Over a full, uniform disc the terms are orthogonal: a coefficient does not depend
on how many terms are fitted, and the variance is the sum of squares of the standard coefficients
without piston.  Over a ring or a vignetted pupil they are not orthogonal; only the whole fit, and
its residual, mean something there (Mahajan, J. Opt. Soc. Am. 71, 75, 1981, has terms for rings).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.optics.surfaces.zernike import FRINGE_TERMS, ZernikeTerm, fringe, jacobi, noll

ORDERS = {"fringe": fringe, "standard": noll}
# Terms that are fitted unless another number is asked for: all of the fringe order.
TERMS = FRINGE_TERMS
_MOST_STANDARD = 231
# Singular values below this share of the largest are of terms that the light does not tell apart.
_RANK = 1e-9

_GREEK = {0: "", 1: "secondary ", 2: "tertiary ", 3: "quaternary "}
_FOILS = {3: "trefoil", 4: "tetrafoil", 5: "pentafoil", 6: "hexafoil"}


@dataclass(frozen=True)
class ZernikeFit:
    """A `ZernikeFit` holds Zernike coefficients of wavefronts (...), with J terms.

    Attributes:
        order: `fringe`, of value 1 at the edge, or `standard`, Noll's, of unit variance.
        terms: (J,), radial and azimuthal orders, cosine or sine, norm.
        coefficients: (..., J), in the unit of the wavefront.
        residual_rms: (...), root mean square of what no term describes, weighted as the fit.
        rank: (...), how many terms the light tells apart; J where it tells all.
    """

    order: str
    terms: tuple[ZernikeTerm, ...]
    coefficients: Tensor
    residual_rms: Tensor
    rank: Tensor

    @property
    def names(self) -> tuple[str, ...]:
        """Return the textbook names of the terms."""
        return tuple(map(zernike_name, self.terms))

    def values(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the fitted wavefront (..., M) at points x and y (M,) of the unit disc."""
        return self.coefficients @ zernike_polynomials(x, y, self.terms)


def zernike_terms(order: str, count: int = TERMS) -> tuple[ZernikeTerm, ...]:
    """Return the first terms of an order.

    Args:
        order: `fringe` or `standard`.
        count: 1 to 37 for fringe, to 231 for standard.

    Raises:
        InputError: another order, or a number that it does not have.
    """
    check_choice(order, ORDERS, "order")
    most = FRINGE_TERMS if order == "fringe" else _MOST_STANDARD
    if not 1 <= count <= most:
        raise InputError(f"{order} Zernike terms are 1 to {most}, not {count}")
    return tuple(ORDERS[order](number) for number in range(1, count + 1))


def zernike_polynomials(x: Tensor, y: Tensor, terms: Sequence[ZernikeTerm]) -> Tensor:
    """Return norm·R_n^m(ρ)·cos(mφ), or sin(mφ), φ from +x towards +y.

    Args:
        x: (...), over the radius of the disc.
        y: (...).
        terms: J of them.

    Returns:
        (J, ...).
    """
    q = x * x + y * y
    cosine, sine = torch.ones_like(q), torch.zeros_like(q)
    found = [q] * len(terms)  # each is replaced below
    for m in range(max(term.m for term in terms) + 1):
        orders = [(term.n - m) // 2 for term in terms if term.m == m]
        radial = list(jacobi(q, m, max(orders, default=-1) + 1))
        for place, term in enumerate(terms):
            if term.m == m:
                azimuthal = sine if term.sine else cosine
                found[place] = term.norm * azimuthal * radial[(term.n - m) // 2]
        cosine, sine = cosine * x - sine * y, sine * x + cosine * y
    return torch.stack(found)


def zernike_fit(
    values: Tensor,
    x: Tensor,
    y: Tensor,
    weights: Tensor,
    order: str = "fringe",
    count: int = TERMS,
) -> ZernikeFit:
    """Fit Zernike polynomials by weighted least squares; linear, and so differentiable, in values.

    Where the light does not tell all terms apart, as through a sliver, the coefficients are those
    of least norm, and `rank` says how many it tells.

    Args:
        values: (..., M), of wavefronts.
        x: (..., M), over the radius of the disc.
        y: (..., M).
        weights: (..., M), not negative, of any sum; zero leaves a point out.  No gradient.
        order: `fringe` or `standard`.
        count: J.

    Returns:
        The fit; NaN where no point has a weight.

    Raises:
        InputError: another order, or a number of terms that it does not have.
    """
    terms = zernike_terms(order, count)
    weights = weights.detach()
    total = weights.sum(-1, keepdim=True)
    share = (weights / total).nan_to_num(0.0)
    lit = share > 0.0
    x, y, values = (torch.where(lit, part, 0.0) for part in (x, y, values))
    root = share.sqrt()
    basis = zernike_polynomials(x.detach(), y.detach(), terms).movedim(0, -1)
    weighted = root[..., None] * basis
    inverse = torch.linalg.pinv(weighted, rtol=_RANK)
    rank = torch.linalg.matrix_rank(weighted, rtol=_RANK)
    found = (inverse @ (root * values)[..., None])[..., 0]
    missed = values - (basis @ found[..., None])[..., 0]
    dark = torch.where(total > 0.0, 0.0, torch.nan)
    residual = (share * missed.square()).sum(-1).sqrt() + dark[..., 0]
    return ZernikeFit(order, terms, found + dark, residual, rank)


def zernike_name(term: ZernikeTerm) -> str:
    """Return the textbook name of a term: `piston`, `tilt x`, `defocus`, `astigmatism 0°`, ..."""
    n, m = term.n, term.m
    if m == 0:
        if n < 4:
            return "piston" if n == 0 else "defocus"
        return f"{_GREEK.get(n // 2 - 2, f'{n}th-order ')}spherical"
    # Tilt, coma and their successors have a direction; of 2φ and more, an angle of the pattern.
    if m <= 2:
        base = {1: "coma", 2: "astigmatism"}[m]
        side = ("y" if term.sine else "x") if m == 1 else ("45°" if term.sine else "0°")
        if n == 1:
            return f"tilt {side}"
        step = (n - 3) // 2 if m == 1 else (n - 2) // 2
        return f"{_GREEK.get(step, f'{n}th-order ')}{base} {side}"
    base = _FOILS.get(m, f"{m}-foil")
    return f"{_GREEK.get((n - m) // 2, f'{n}th-order ')}{base} {'y' if term.sine else 'x'}"
