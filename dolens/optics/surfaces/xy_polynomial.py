"""An XY polynomial may have the implicit b·z² term (S5, S6)."""

import re
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from dolens.kernels.operations import (
    Number,
    divide,
    entry,
    fma,
    length,
    number,
    put,
    safe_sqrt,
    term,
    zero,
)
from dolens.kernels.shapes import TABLE, Shape
from dolens.kernels.table import Code
from dolens.optics.surfaces.base import Parameters, Surface
from dolens.optics.surfaces.registry import checked_order, register_surface

_MONOMIAL = re.compile(r"(?:(x)([2-9]|[1-9][0-9]+)?)?(?:(y)([2-9]|[1-9][0-9]+)?)?")


def monomial_powers(name: str) -> tuple[int, int] | None:
    """Return the powers (i, j) of a coefficient named by its monomial x^i·y^j, or None for another
    name.

    `x3` is (3, 0), `x2y` (2, 1), `xy` (1, 1), `y3` (0, 3); a power of one is not written.

    Raises:
        InputError: a power is beyond what a surface can have.
    """
    match = _MONOMIAL.fullmatch(name)
    if match is None or not name:
        return None
    x, i, y, j = match.groups()
    powers = [
        checked_order(power or "1", name) if letter else 0 for letter, power in ((x, i), (y, j))
    ]
    return powers[0], powers[1]


def horner_order(
    found: Mapping[tuple[int, int], Any],
) -> tuple[tuple[Any, ...], tuple[int, ...]]:
    """Return coefficients of monomials in Horner's order, 0.0 between them, and their powers.

    Of each power of y that there is, and the lower ones, all powers of x from the highest.
    """
    highest = [0] * (1 + max((j for _, j in found), default=0))
    for i, j in found:
        highest[j] = max(highest[j], i)
    order = [(i, j) for j, most in reversed([*enumerate(highest)]) for i in range(most, -1, -1)]
    return tuple(found.get(powers, 0.0) for powers in order), tuple(n for ij in order for n in ij)


def polynomial(a: Any, table: Any, x: Number, y: Number) -> tuple[Number, Number, Number]:
    """Return P, P_x and P_y by Horner's rule in x within one in y.

    The table tells for each coefficient the powers of x and y, behind a number that is not of these
    functions.
    """
    p, px, py = zero(x), zero(x), zero(x)
    r, rx = zero(x), zero(x)
    for t in range(length(a)):
        rx = fma(rx, x, r)
        r = fma(r, x, term(a, t))
        if entry(table, 2 * t + 1) == 0:  # the last of this power of y
            py = fma(py, y, p)
            px = fma(px, y, rx)
            p = fma(p, y, r)
            r, rx = zero(x), zero(x)
    return p, px, py


def polynomial_second(
    a: Any, table: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return P, P_x, P_y, P_xx, P_xy and P_yy."""
    p, px, py, half_pxx, pxy, half_pyy = zero(x), zero(x), zero(x), zero(x), zero(x), zero(x)
    r, rx, half_rxx = zero(x), zero(x), zero(x)
    for t in range(length(a)):
        half_rxx = fma(half_rxx, x, rx)
        rx = fma(rx, x, r)
        r = fma(r, x, term(a, t))
        if entry(table, 2 * t + 1) == 0:
            half_pyy = fma(half_pyy, y, py)
            py = fma(py, y, p)
            half_pxx = fma(half_pxx, y, half_rxx)
            pxy = fma(pxy, y, px)
            px = fma(px, y, rx)
            p = fma(p, y, r)
            r, rx, half_rxx = zero(x), zero(x), zero(x)
    return p, px, py, 2.0 * half_pxx, pxy, 2.0 * half_pyy


def put_polynomial(
    cotangents: Any, place: int, a: Any, table: Any, x: Number, y: Number,
    of_p: Number, of_x: Number, of_y: Number,
) -> None:  # fmt: skip
    """Set the cotangents of the coefficients, from `place` on, from those of P, P_x and P_y.

    From the last monomial back: the powers grow, with the next lower ones behind them.
    """
    u, u_below, v, v_below = zero(x) + 1.0, zero(x), zero(x) + 1.0, zero(x)
    for back in range(length(a)):
        t = length(a) - 1 - back
        i, j = entry(table, 2 * t + 1), entry(table, 2 * t + 2)
        if i == 0:
            u, u_below = zero(x) + 1.0, zero(x)
            if j > 0:
                v_below = v
                v = v * y
        of_a = of_p * u * v + of_x * number(i, x) * u_below * v
        put(cotangents, place + t, of_a + of_y * number(j, x) * u * v_below)
        u_below = u
        u = u * x


def xy_polynomial_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag, slopes, and the margin W² of the branch through the vertex."""
    b, a, table = p
    sag, sx, sy = polynomial(a, table, x, y)
    margin = zero(x) + 1.0
    if entry(table, 0) > 0:
        margin = 1.0 - 4.0 * b * sag
        root = safe_sqrt(margin)
        sag = divide(2.0 * sag, 1.0 + root)
        sx, sy = divide(sx, root), divide(sy, root)
    return sag, sx, sy, margin


def xy_polynomial_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives: s_xy = P_xy/W + 2b·s_x·s_y/W."""
    b, a, table = p
    sag, sx, sy, sxx, sxy, syy = polynomial_second(a, table, x, y)
    if entry(table, 0) > 0:
        inverse = divide(1.0, safe_sqrt(1.0 - 4.0 * b * sag))
        factor = 2.0 * b * inverse
        sx, sy = sx * inverse, sy * inverse
        sxx = sxx * inverse + factor * sx * sx
        sxy = sxy * inverse + factor * sx * sy
        syy = syy * inverse + factor * sy * sy
    return sx, sy, sxx, sxy, syy


def xy_polynomial_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of b and the coefficients.

    Those of P, P_x and P_y first: s_P = 1/W, ∂s_x/∂P = 2b·P_x/W³; and with b, s_b = s²/W and
    ∂s_x/∂b = 2P·P_x/W³.
    """
    b, a, table = p
    of_b = zero(x)
    if entry(table, 0) > 0:
        value, px, py = polynomial(a, table, x, y)
        root = safe_sqrt(1.0 - 4.0 * b * value)
        inverse = divide(1.0, root)
        cubed = 2.0 * inverse * inverse * inverse * (of_x * px + of_y * py)
        sag = divide(2.0 * value, 1.0 + root)
        of_b = of_sag * sag * sag * inverse + value * cubed
        of_sag = of_sag * inverse + b * cubed
        of_x, of_y = of_x * inverse, of_y * inverse
    put(cotangents, 0, of_b)
    put_polynomial(cotangents, 1, a, table, x, y, of_sag, of_x, of_y)


XY_POLYNOMIAL = Shape(
    "xy_polynomial",
    xy_polynomial_sag,
    xy_polynomial_hessian,
    xy_polynomial_parameters,
    layout=(None, Code.COUNT, TABLE),
)


@register_surface
class XYPolynomial(Surface):
    """The surface is Σ a_ij·x^i·y^j + b·z² - z = 0; coefficients are named by their monomials,
    mm^(1 - i - j).

    The branch through the vertex is explicit: z = 2P/(1 + √(1 - 4bP)) with P = Σ a_ij·x^i·y^j,
    and there 1 - 2bz = √(1 - 4bP), so its slopes are P_x and P_y over that root.
    """

    kind = "xy_polynomial"
    shape = XY_POLYNOMIAL

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the monomials that the prescription names, and b where it is named."""
        return [str(key) for key in keys if key == "b" or monomial_powers(str(key)) is not None]

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return b, the coefficients in Horner's order, and the table of their powers."""
        coefficients, table = horner_order(
            {powers: a for n, a in p.items() if (powers := monomial_powers(n)) is not None}
        )
        return p.get("b", 0.0), coefficients, (int("b" in p), *table)

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return x2 + y2: the mean over azimuth of the curvature at the vertex."""
        return p.get("x2", 0.0) + p.get("y2", 0.0)
