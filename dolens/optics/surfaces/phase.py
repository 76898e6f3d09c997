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
from dolens.kernels.limits import LONGEST, LONGEST_WAVEVECTOR, STEEPEST
from dolens.kernels.operations import safe_sqrt
from dolens.kernels.surface_kernel import LawKernel
from dolens.optics.surfaces.base import Parameters, by_names, tensor_of
from dolens.optics.surfaces.deflection import (
    Deflected,
    Law,
    Media,
    Number,
    ParaxialPower,
    Travel,
    Vector,
)
from dolens.optics.surfaces.registry import order_of, order_pattern
from dolens.optics.surfaces.xy_polynomial import monomial_powers

# Path in mm for a radian of phase, over the wavelength in nm.
_PATH = 1e-6 / (2.0 * math.pi)
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
        raise NotImplementedError

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
        gx, gy = scale * gx, scale * gy
        (l, m, n), (nx, ny, nz) = direction, normal  # noqa: E741
        ax, ay, az = ratio * l + gx, ratio * m + gy, ratio * n
        along = (ax * nx + ay * ny + az * nz).clamp(-LONGEST_WAVEVECTOR, LONGEST_WAVEVECTOR)
        # 1 - |a|² without the cancellation of |d|² = 1: Snell's law where there is no phase.
        more = gx * (ax + ratio * l) + gy * (ay + ratio * m)
        squared = (1.0 - ratio * ratio) - more + along * along
        change = travel.behind * safe_sqrt(squared) - along
        # Directions of rays that ended stay in single precision's range.
        return Deflected(
            torch.addcmul(ax, change, nx).clamp(-LONGEST, LONGEST),
            torch.addcmul(ay, change, ny).clamp(-LONGEST, LONGEST),
            torch.addcmul(az, change, nz).clamp(-LONGEST, LONGEST),
            squared.detach().masked_fill(wild, -1.0),
            media.per_radian * phase,
        )


_Phase = TypeVar("_Phase", bound=Phase)
PHASES: dict[str, type[Phase]] = {}


def register_phase(phase: type[_Phase]) -> type[_Phase]:
    """Make a phase known to prescriptions under its `type`; usable as a decorator."""
    PHASES[phase.type] = phase
    return phase


@register_phase
class Grating(Phase):
    """The phase of straight grooves parallel to x, equally spaced in y: φ = 2π·G·y with G grooves
    per mm.
    """

    type = "grating"
    kind = "grating"
    kernel = LawKernel("dolens.kernels.cpu.phases.grating", "dolens.kernels.cuda.phases.grating")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the order and the number of grooves per mm."""
        if "grooves" not in keys:
            raise InputError("a phase of type grating needs 'grooves', their number per mm")
        return ["order", "grooves"]

    @classmethod
    def phase_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return 2π·m·G·y and its gradient."""
        slope = (2.0 * math.pi) * p["order"] * p["grooves"]
        return slope * y, torch.zeros_like(y), slope + torch.zeros_like(y)

    @classmethod
    @by_names
    def packed(cls, p: Parameters, forward: bool) -> tuple[Tensor, ...]:
        """Return order and grooves."""
        return p["order"], p["grooves"]

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return zero: paraxial optics follows the axis that the grating turns."""
        return ParaxialPower(0.0, 0.0)


@register_phase
class RadialPhase(Phase):
    """The phase is φ = p2·ρ² + p4·ρ⁴ + ... with ρ = r/norm_radius; coefficients in radians."""

    type = "radial"
    kind = "radial phase"
    kernel = LawKernel("dolens.kernels.cpu.phases.radial", "dolens.kernels.cuda.phases.radial")
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

    @staticmethod
    def coefficients(p: Parameters) -> list[Tensor | None]:
        """Return p2, p4, ... up to the highest power that is there; None: zero."""
        highest = max((int(name[1:]) for name in p if _TERM.fullmatch(name)), default=0)
        return [p.get(f"p{power}") for power in range(2, highest + 1, 2)]

    @classmethod
    def phase_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the phase and its gradient by Horner's rule in q = ρ²."""
        inverse = 1.0 / p["norm_radius"]
        u, v = inverse * x, inverse * y
        q = u * u + v * v
        # φ = q·h(q).
        h, slope = torch.zeros_like(q), torch.zeros_like(q)
        for coefficient in reversed(cls.coefficients(p)):
            slope = torch.addcmul(h, slope, q)
            h = h * q if coefficient is None else torch.addcmul(coefficient, h, q)
        twice = (2.0 * p["order"] * inverse) * torch.addcmul(h, slope, q)
        return p["order"] * (q * h), twice * u, twice * v

    @classmethod
    @by_names
    def packed(cls, p: Parameters, forward: bool) -> tuple[Tensor | None, ...]:
        """Return order, radius of normalisation, p2, p4, ..."""
        return (p["order"], p["norm_radius"], *cls.coefficients(p))

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return -2·(the coefficient of r² in the path): -m·p2·λ/(π·norm_radius²)."""
        square = p.get("p2", 0.0)
        return ParaxialPower(0.0, -2.0 * _PATH * p["order"] * square / p["norm_radius"] ** 2)

    @classmethod
    def fourth_order_path(cls, p: Parameters) -> Number:
        """Return m·p4/norm_radius⁴, as a path over the wavelength."""
        return _PATH * p["order"] * p.get("p4", 0.0) / p["norm_radius"] ** 4


@register_phase
class XYPhase(Phase):
    """The phase is φ = Σ a_ij·(x/R)^i·(y/R)^j with R = norm_radius; coefficients, in radians, are
    named by their monomials: `x`, `y`, `x2`, `xy`, ...
    """

    type = "xy"
    kind = "XY phase"
    kernel = LawKernel("dolens.kernels.cpu.phases.xy", "dolens.kernels.cuda.phases.xy")

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return order, radius of normalisation, and the monomials that the prescription names."""
        names = [str(key) for key in keys if monomial_powers(str(key)) is not None]
        return ["order", "norm_radius", *names]

    @staticmethod
    def coefficients(p: Parameters) -> list[Tensor | None]:
        """Return the coefficients of x, y, x², xy, y², x³, ...: all of each degree up to the
        highest, i falling; None: zero.
        """
        found = {
            powers: value
            for name, value in p.items()
            if (powers := monomial_powers(name)) is not None
        }
        degree = max((i + j for i, j in found), default=0)
        return [found.get((d - j, j)) for d in range(1, degree + 1) for j in range(d + 1)]

    @classmethod
    def phase_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the phase and its gradient by Horner's rule in x within one in y."""
        inverse = 1.0 / p["norm_radius"]
        u, v = inverse * x, inverse * y
        found = {
            powers: value
            for name, value in p.items()
            if (powers := monomial_powers(name)) is not None
        }
        degree = max((i + j for i, j in found), default=0)
        zero = torch.zeros_like(u)
        value, du, dv = zero, zero, zero
        for j in range(degree, -1, -1):
            row, slope = zero, zero
            for i in range(degree - j, -1, -1):
                a = found.get((i, j))
                slope = torch.addcmul(row, slope, u)
                row = row * u if a is None else torch.addcmul(a, row, u)
            dv = torch.addcmul(value, dv, v)
            value = torch.addcmul(row, value, v)
            du = torch.addcmul(slope, du, v)
        scale = p["order"] * inverse
        return p["order"] * value, scale * du, scale * dv

    @classmethod
    @by_names
    def packed(cls, p: Parameters, forward: bool) -> tuple[Tensor | None, ...]:
        """Return order, radius of normalisation, and the coefficients of `coefficients`."""
        return (p["order"], p["norm_radius"], *cls.coefficients(p))

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
