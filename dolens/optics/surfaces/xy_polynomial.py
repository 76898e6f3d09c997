"""XY polynomials with the implicit b·z² term (S5, S6)."""

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.optics.surfaces.base import Parameters, Surface


def monomial_powers(name: str) -> tuple[int, int] | None:
    """Powers (i, j) of a coefficient named by its monomial x^i·y^j, or None for another name.

    `x3` is (3, 0), `x2y` (2, 1), `xy` (1, 1), `y3` (0, 3); a power of one is not written.
    """
    match = re.fullmatch(r"(?:(x)([2-9]|[1-9]\d+)?)?(?:(y)([2-9]|[1-9]\d+)?)?", name)
    if match is None or not name:
        return None
    x, i, y, j = match.groups()
    return (int(i or 1) if x else 0), (int(j or 1) if y else 0)


class XYPolynomial(Surface):
    """Σ a_ij·x^i·y^j + b·z² - z = 0; coefficients named by their monomials, mm^(1 - i - j).

    The branch through the vertex is explicit: z = 2P/(1 + √(1 - 4bP)) with P = Σ a_ij·x^i·y^j,
    and there 1 - 2bz = √(1 - 4bP), so its slopes are P_x and P_y over that root.
    """

    kind = "xy_polynomial"

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """The term b and the monomials that the prescription names."""
        return ["b", *(str(key) for key in keys if monomial_powers(str(key)) is not None)]

    @staticmethod
    def sag_and_gradient(p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """Sag and slopes of the branch through the vertex."""
        polynomial, px, py = _evaluate(p, x, y)
        discriminant = 1.0 - 4.0 * p["b"] * polynomial
        inside = discriminant > 0.0
        root = torch.sqrt(torch.where(inside, discriminant, torch.ones_like(discriminant)))
        return 2.0 * polynomial / (1.0 + root), px / root, py / root, inside

    @staticmethod
    def paraxial_curvature(p: Parameters) -> Tensor:
        """x2 + y2: the mean over azimuth of the curvature at the vertex."""
        zero = torch.zeros_like(p["b"])
        return p.get("x2", zero) + p.get("y2", zero)


def _evaluate(p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """P and its two derivatives, from tables of the powers of x and y."""
    terms = [(powers, p[name]) for name in p if (powers := monomial_powers(name)) is not None]
    degree = max((max(powers) for powers, _ in terms), default=0)
    x_powers = _power_table(x, degree)
    y_powers = _power_table(y, degree)
    zero = torch.zeros_like(x * y)
    value, dx, dy = zero, zero, zero
    for (i, j), a in terms:
        value = value + a * _product(x_powers[i], y_powers[j])
        if i:
            dx = dx + (i * a) * _product(x_powers[i - 1], y_powers[j])
        if j:
            dy = dy + (j * a) * _product(x_powers[i], y_powers[j - 1])
    return value, dx, dy


def _power_table(x: Tensor, degree: int) -> list[Tensor | None]:
    """x⁰ (as None, a factor of one), x¹, x², ... x^degree."""
    table: list[Tensor | None] = [None]
    for _ in range(degree):
        table.append(x if table[-1] is None else table[-1] * x)
    return table


def _product(a: Tensor | None, b: Tensor | None) -> Tensor | float:
    if a is None:
        return 1.0 if b is None else b
    return a if b is None else a * b
