"""Zernike polynomials are numbered in two ways: Noll's, and that of the University of Arizona."""

import math
from functools import cache
from typing import NamedTuple

FRINGE_TERMS = 37


class ZernikeTerm(NamedTuple):
    """The term is norm · R_n^m(ρ) · cos(mφ), or sin(mφ).

    Attributes:
        n: radial order.
        m: azimuthal order, not negative.
        sine: sin(mφ) instead of cos(mφ).
        norm: factor of the polynomial.
    """

    n: int
    m: int
    sine: bool
    norm: float


@cache
def noll(number: int) -> ZernikeTerm:
    """Return a term in Noll's order, of unit variance over the unit disc.

    Even numbers are cosines, odd ones sines; the norm is √(n+1), times √2 for m > 0.
    Source: Noll, Zernike polynomials and atmospheric turbulence, J. Opt. Soc. Am. 66, 207 (1976).
    Zemax calls this order and norm "Zernike Standard".
    """
    n = 0
    while (n + 1) * (n + 2) // 2 < number:
        n += 1
    place = number - n * (n + 1) // 2  # from 1 within this radial order
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    return ZernikeTerm(n, m, m > 0 and number % 2 == 1, math.sqrt((n + 1) * (2 if m else 1)))


@cache
def fringe(number: int) -> ZernikeTerm:
    """Return a term in the University of Arizona's order, of value 1 at the edge on its axis.

    Groups have equal n + m; within one m falls from n to 0, the cosine before the sine.  The last
    of the 37 terms is that of ρ¹² alone, out of this order.
    """
    if number == FRINGE_TERMS:
        return ZernikeTerm(12, 0, False, 1.0)
    group = math.isqrt(number - 1)  # (n + m)/2
    place = number - group * group - 1  # from 0 within the group
    m = group - place // 2
    return ZernikeTerm(2 * group - m, m, m > 0 and place % 2 == 1, 1.0)
