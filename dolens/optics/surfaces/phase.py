"""A phase on a surface: gratings, and diffractive lenses.

A phase φ(x, y), in radians of the first order, adds m·∇φ to the wavevector along the surface in
order m.  With the direction d and the index n in front, d' and n' behind, the unit normal N and
g = m·λ/(2π·n')·(φ_x, φ_y, 0),

    d' = a + (s'·√(1 - |a|² + (a·N)²) - a·N)·N,    a = (n/n')·d + g

with the sense s' of the light behind.  Only what lies along the surface matters of g: on a curved
surface this is the vector grating equation n'·(d' × N) = n·(d × N) + m·λ·(G × N) of grooves whose
planes are equally spaced in projection.  The path grows by m·φ·λ/2π, so that rays stay normal to
the wavefront.  Signs are those of Zemax: light of order m > 0 turns to where φ rises, and a lens
that focuses has a φ that falls from its centre.

An order whose wavevector along the surface is longer than 2π·n'/λ is evanescent: the ray ends with
the status of a total reflection.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.kernels.operations import (
    Number,
    divide,
    fma,
    horner,
    horner_second,
    length,
    put,
    put_powers,
    zero,
)
from dolens.kernels.refraction import deflect
from dolens.kernels.shapes import TABLE, PhaseFunctions
from dolens.kernels.surface_kernel import LawKernel
from dolens.kernels.table import STEEPEST, Code
from dolens.optics.surfaces.base import Parameters, everywhere, tensor_of
from dolens.optics.surfaces.deflection import (
    Deflected,
    Law,
    Media,
    ParaxialPower,
    Travel,
    Vector,
)
from dolens.optics.surfaces.registry import order_of, order_pattern
from dolens.optics.surfaces.xy_polynomial import (
    horner_order,
    monomial_powers,
    polynomial,
    polynomial_second,
    put_polynomial,
)

# Path in mm for a radian of phase, over the wavelength in nm.
_PATH = 1e-6 / (2.0 * math.pi)
_TURN = 2.0 * math.pi
_TERM = order_pattern("p")


class Phase(Law):
    """A phase has an order and an efficiency besides its parameters.

    Args:
        parameters: name → number; `order` and `norm_radius` among them are constants.
        dtype: precision of the parameters.
        efficiency: the share of the light that goes into the order, from 0 to 1; None: not known.
            It is data: rays carry no flux.

    Attributes:
        type: the name in a prescription.
        constants: names among the parameters that no optimizer varies.
    """

    type: ClassVar[str] = ""  # type: ignore[assignment]  # in the place of a cast of modules
    constants: ClassVar[tuple[str, ...]] = ("order", "norm_radius")

    def __init__(
        self,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
        efficiency: float | None = None,
    ) -> None:
        super().__init__()
        if efficiency is not None and not 0.0 <= efficiency <= 1.0:
            raise InputError(f"'efficiency' must be from 0 to 1, not {efficiency}")
        self.efficiency = efficiency
        for name, value in parameters.items():
            tensor = tensor_of(value, name, dtype)
            if name in self.constants:
                self.register_buffer(name, tensor)
            else:
                self.register_parameter(name, nn.Parameter(tensor))

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the parameters of a phase with these keys in its prescription.

        Raises:
            InputError: a key that names no coefficient, or a necessary one that is missing.
        """
        raise NotImplementedError

    @classmethod
    def phase_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return m·φ (radians), and m·∂φ/∂x and m·∂φ/∂y (1/mm), at points x, y (mm)."""
        functions = cls.kernel and cls.kernel.functions
        if not isinstance(functions, PhaseFunctions):
            raise NotImplementedError
        phase, gx, gy = everywhere(functions.phase(cls.numbers(p), x, y), x, y)
        return phase, gx, gy

    @classmethod
    def deflect(
        cls,
        p: Parameters,
        point: Vector,
        direction: Vector,
        normal: Vector,
        media: Media,
        travel: Travel,
    ) -> Deflected:
        """Add the phase's gradient to the wavevector along the surface; see the module."""
        ratio, scale = media.before / media.behind, media.per_radian / media.behind
        x, y, _ = point
        with torch.no_grad():
            _, gx, gy = cls.phase_and_gradient(p, x, y)
            wild = ~((scale * gx).abs() + (scale * gy).abs() < STEEPEST)
        # High powers far outside the aperture overflow, and their derivatives are not finite.
        x, y = x.masked_fill(wild, 0.0), y.masked_fill(wild, 0.0)
        phase, gx, gy = cls.phase_and_gradient(p, x, y)
        l, m, n, squared = deflect(  # noqa: E741
            scale * gx, scale * gy, *direction, *normal, ratio, travel.behind
        )
        evanescent = squared.detach().masked_fill(wild, -1.0)
        return Deflected(l, m, n, evanescent, media.per_radian * phase)


_Phase = TypeVar("_Phase", bound=Phase)
PHASES: dict[str, type[Phase]] = {}


def register_phase(phase: type[_Phase]) -> type[_Phase]:
    """Make a phase known to prescriptions under its `type`; usable as a decorator."""
    PHASES[phase.type] = phase
    return phase


def grating_phase(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number]:
    """Return 2π·m·G·y and its gradient."""
    order, grooves = p
    slope = _TURN * order * grooves
    return slope * y, zero(x), slope + zero(x)


def grating_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return 2π·m·G·y, its gradient, and second derivatives of zero."""
    order, grooves = p
    slope = _TURN * order * grooves
    return slope * y, zero(x), slope + zero(x), zero(x), zero(x), zero(x)


def grating_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_phase: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangent of the grooves; the order is no variable."""
    order, _ = p
    put(cotangents, 0, zero(x))
    put(cotangents, 1, _TURN * order * (of_phase * y + of_y))


GRATING = PhaseFunctions(
    "grating", grating_phase, grating_hessian, grating_parameters, (None, None)
)


@register_phase
class Grating(Phase):
    """The phase of straight grooves parallel to x, equally spaced in y: φ = 2π·G·y with G grooves
    per mm.
    """

    type = "grating"
    kind = "grating"
    kernel = LawKernel(GRATING)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the order and the number of grooves per mm."""
        if "grooves" not in keys:
            raise InputError("a phase of type grating needs 'grooves', their number per mm")
        return ["order", "grooves"]

    @classmethod
    def numbers(cls, p: Parameters, forward: bool = True) -> tuple[Any, ...]:
        """Return order and grooves."""
        return p["order"], p["grooves"]

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return zero: paraxial optics follows the axis that the grating turns."""
        return ParaxialPower(0.0, 0.0)


def radial_phase(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number]:
    """Return the phase m·q·h(q) with q = ρ² and h = p2 + p4·q + ..., and its gradient."""
    order, radius, series = p
    inverse = divide(1.0, radius)
    u, v = inverse * x, inverse * y
    q = fma(u, u, v * v)
    h, d = horner(series, q)
    twice = 2.0 * order * inverse * fma(q, d, h)
    return order * (q * h), twice * u, twice * v


def radial_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return phase, gradient and second derivatives: φ'' = m(2h' + q·h'')."""
    order, radius, series = p
    inverse = divide(1.0, radius)
    u, v = inverse * x, inverse * y
    q = fma(u, u, v * v)
    h, d, e = horner_second(series, q)
    twice = 2.0 * order * inverse * fma(q, d, h)
    slope = twice * inverse
    second = 8.0 * order * inverse * inverse * fma(q, e, d)
    return (
        order * (q * h),
        twice * u,
        twice * v,
        slope + second * u * u,
        second * u * v,
        slope + second * v * v,
    )


def radial_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_phase: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of p2, p4, ...; order and radius are no variables."""
    order, radius, series = p
    inverse = divide(1.0, radius)
    u, v = inverse * x, inverse * y
    q = fma(u, u, v * v)
    put(cotangents, 0, zero(x))
    put(cotangents, 1, zero(x))
    of_slope = 2.0 * inverse * (u * of_x + v * of_y)
    put_powers(cotangents, 2, length(series), order + zero(x), q, of_phase, of_slope, 1, 1)


RADIAL = PhaseFunctions(
    "radial_phase", radial_phase, radial_hessian, radial_parameters, (None, None, Code.LAW_COUNT)
)


@register_phase
class RadialPhase(Phase):
    """The phase is φ = p2·ρ² + p4·ρ⁴ + ... with ρ = r/norm_radius; coefficients in radians."""

    type = "radial"
    kind = "radial phase"
    kernel = LawKernel(RADIAL)
    rotational = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return order, radius of normalisation, and the coefficients that the prescription
        names.
        """
        powers = []
        for key in keys:
            power = order_of(_TERM, key)
            if power is None:
                continue
            if power % 2:
                raise InputError(f"'{key}': coefficients of a radial phase are p2, p4, p6, ...")
            powers.append(power)
        return ["order", "norm_radius", *(f"p{power}" for power in sorted(powers))]

    @classmethod
    def numbers(cls, p: Parameters, forward: bool = True) -> tuple[Any, ...]:
        """Return order, radius of normalisation, and p2, p4, ... up to the highest."""
        highest = max((int(name[1:]) for name in p if _TERM.fullmatch(name)), default=0)
        series = tuple(p.get(f"p{power}", 0.0) for power in range(2, highest + 1, 2))
        return p["order"], p["norm_radius"], series

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return -2·(the coefficient of r² in the path): -m·p2·λ/(π·norm_radius²)."""
        square = p.get("p2", 0.0)
        return ParaxialPower(0.0, -2.0 * _PATH * p["order"] * square / p["norm_radius"] ** 2)

    @classmethod
    def fourth_order_path(cls, p: Parameters) -> Number:
        """Return m·p4/norm_radius⁴, as a path over the wavelength."""
        return _PATH * p["order"] * p.get("p4", 0.0) / p["norm_radius"] ** 4


def xy_phase(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number]:
    """Return the phase and its gradient."""
    order, radius, a, table = p
    inverse = divide(1.0, radius)
    value, du, dv = polynomial(a, table, inverse * x, inverse * y)
    slope = order * inverse
    return order * value, slope * du, slope * dv


def xy_hessian(
    p: Any, x: Number, y: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Return phase, gradient and second derivatives."""
    order, radius, a, table = p
    inverse = divide(1.0, radius)
    value, du, dv, uu, uv, vv = polynomial_second(a, table, inverse * x, inverse * y)
    slope = order * inverse
    second = slope * inverse
    return order * value, slope * du, slope * dv, second * uu, second * uv, second * vv


def xy_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_phase: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of the coefficients; order and radius are no variables."""
    order, radius, a, table = p
    put(cotangents, 0, zero(x))
    put(cotangents, 1, zero(x))
    inverse = divide(1.0, radius)
    slope = order * inverse
    put_polynomial(
        cotangents, 2, a, table, inverse * x, inverse * y,
        order * of_phase, slope * of_x, slope * of_y,
    )  # fmt: skip


XY_PHASE = PhaseFunctions(
    "xy_phase", xy_phase, xy_hessian, xy_parameters, (None, None, Code.LAW_COUNT, TABLE)
)


@register_phase
class XYPhase(Phase):
    """The phase is φ = Σ a_ij·(x/R)^i·(y/R)^j with R = norm_radius; coefficients, in radians, are
    named by their monomials: `x`, `y`, `x2`, `xy`, ...
    """

    type = "xy"
    kind = "XY phase"
    kernel = LawKernel(XY_PHASE)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return order, radius of normalisation, and the monomials that the prescription names."""
        names = [str(key) for key in keys if monomial_powers(str(key)) is not None]
        return ["order", "norm_radius", *names]

    @classmethod
    def numbers(cls, p: Parameters, forward: bool = True) -> tuple[Any, ...]:
        """Return order, radius of normalisation, the coefficients, and the table of their
        powers.
        """
        coefficients, table = horner_order(
            {powers: a for n, a in p.items() if (powers := monomial_powers(n)) is not None}
        )
        # The table's first number is a polynomial surface's own.
        return p["order"], p["norm_radius"], coefficients, (0, *table)

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return -2·(the mean over azimuth of the coefficient of r² in the path)."""
        square = 0.5 * (p.get("x2", 0.0) + p.get("y2", 0.0))
        return ParaxialPower(0.0, -2.0 * _PATH * p["order"] * square / p["norm_radius"] ** 2)

    @classmethod
    def section_power(cls, p: Parameters, cosine: Number, sine: Number) -> ParaxialPower:
        """Return -2·(the coefficient of r² in the path along the section)."""
        x2, xy, y2 = (p.get(name, 0.0) for name in ("x2", "xy", "y2"))
        square = x2 * cosine * cosine + xy * cosine * sine + y2 * sine * sine
        return ParaxialPower(0.0, -2.0 * _PATH * p["order"] * square / p["norm_radius"] ** 2)

    @classmethod
    def fourth_order_path(cls, p: Parameters) -> Number:
        """Return the mean over azimuth, (3·x4 + x2y2 + 3·y4)/8.

        Raises:
            InputError: a term that turns the axis or has no rotational symmetry of its own kind
                (x, y, x³, ...), which no Seidel sum describes, is not zero.
        """
        for name, value in p.items():
            powers = monomial_powers(name)
            if powers is not None and sum(powers) % 2 and bool(value != 0.0):
                raise InputError(f"Seidel sums do not describe an XY phase with '{name}'")
        x4, x2y2, y4 = (p.get(name, 0.0) for name in ("x4", "x2y2", "y4"))
        mean = (3.0 * x4 + x2y2 + 3.0 * y4) / 8.0
        return _PATH * p["order"] * mean / p["norm_radius"] ** 4
