"""An XY polynomial may have the implicit b·z² term (S5, S6)."""

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.kernels.operations import safe_sqrt
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names
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


@register_surface
class XYPolynomial(Surface):
    """The surface is Σ a_ij·x^i·y^j + b·z² - z = 0; coefficients are named by their monomials,
    mm^(1 - i - j).

    The branch through the vertex is explicit: z = 2P/(1 + √(1 - 4bP)) with P = Σ a_ij·x^i·y^j,
    and there 1 - 2bz = √(1 - 4bP), so its slopes are P_x and P_y over that root.
    """

    kind = "xy_polynomial"
    kernel = SurfaceKernel("dolens.kernels.cpu.xy_polynomial", "dolens.kernels.cuda.xy_polynomial")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the monomials that the prescription names, and b where it is named."""
        return [str(key) for key in keys if key == "b" or monomial_powers(str(key)) is not None]

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes of the branch through the vertex."""
        polynomial, px, py = _evaluate(p, x, y)
        if "b" not in p:
            return polynomial, px, py, None
        discriminant = 1.0 - (4.0 * p["b"]) * polynomial
        root = safe_sqrt(discriminant)
        return 2.0 * polynomial / (1.0 + root), px / root, py / root, discriminant.detach()

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return b, then the coefficients, and their powers as extras."""
        terms = [(powers, a) for n, a in p.items() if (powers := monomial_powers(n)) is not None]
        flat = [power for powers, _ in terms for power in powers]
        return PackedShape(
            (p.get("b"), *(a for _, a in terms)),
            count=len(terms),
            columns=int("b" in p),
            degree=max(flat, default=0),
            extras=tuple(flat),
        )

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return x2 + y2: the mean over azimuth of the curvature at the vertex."""
        return p.get("x2", 0.0) + p.get("y2", 0.0)


def _evaluate(p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return P, ∂P/∂x and ∂P/∂y; every power and product of powers is computed once."""
    cache: dict[tuple[int, int], Tensor] = {(1, 0): x, (0, 1): y}

    def monomial(i: int, j: int) -> Tensor:
        if (i, j) not in cache:
            if (i, j) == (0, 0):
                cache[i, j] = torch.ones_like(x)
            elif i > j:
                cache[i, j] = monomial(i - 1, j) * x
            else:
                cache[i, j] = monomial(i, j - 1) * y
        return cache[i, j]

    zero = torch.zeros_like(x)
    value, dx, dy = zero, zero, zero
    for name, a in p.items():
        powers = monomial_powers(name)
        if powers is None:
            continue
        i, j = powers
        value = torch.addcmul(value, a, monomial(i, j))
        if i:
            dx = torch.addcmul(dx, a, monomial(i - 1, j), value=i)
        if j:
            dy = torch.addcmul(dy, a, monomial(i, j - 1), value=j)
    return value, dx, dy
