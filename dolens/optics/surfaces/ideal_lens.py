"""An ideal thin lens images every plane sharply, and points at its conjugates with equal paths.

A ray at r = (x, y) whose slopes are u = (l/n, m/n) in a medium of index n leaves with n'u' = n·u -
φ·r, as a paraxial ray does, whatever its angle: lines through a point go on through a point.

No lens makes the paths from all points to their images equal.  This one does so for the points of
one plane, whose reduced vergence V = n/s is the object's at the lens, s in front of it (0: at
infinity): its image lies at s' with n'/s' = φ - V.  The path that the lens adds to a ray is what
the ray through the lens's centre from the same object point has more, n·s·(q₀ - q) + n'·s'·(q₀' -
q'), with q = √(1 + u²) and u₀ = u - r·V/n of the ray through the centre.  Written without s, it
holds for objects and images at infinity:

    Δ = -n·r·(u + u₀)/(q₀ + q) + n'·r·(u' + u₀')/(q₀' + q'),    u₀' = u₀·n/n'

These are Zemax's PARAXIAL with its OPD mode 0 (conjugates from the paraxial axial ray).  The focal
length is meant in air: the power φ is 1/f in any media, as in Zemax.
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.kernels.operations import Number, divide, put, sqrt, where
from dolens.kernels.shapes import LawFunctions
from dolens.kernels.surface_kernel import LawKernel
from dolens.kernels.table import GRAZING
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.deflection import (
    Deflected,
    Law,
    Media,
    ParaxialPower,
    Travel,
    Vector,
)
from dolens.optics.surfaces.plane import Plane
from dolens.optics.surfaces.registry import register_surface


def ideal_lens_forward(
    p: Any, x: Number, y: Number, l: Number, m: Number, n: Number,  # noqa: E741
    index: Number, inverse: Number, ratio: Number, sense: Number,
) -> tuple[Number, Number, Number, Number]:  # fmt: skip
    """Return the direction behind, and the path that is added; see the module.

    Slopes count along the light's own sense.
    """
    power, vergence = p
    bend, turn = power * ratio * inverse, vergence * inverse
    size = where(n < 0.0, -n, n)
    q = divide(1.0, where(size > GRAZING, size, GRAZING))
    ux, uy = l * q, m * q
    vx, vy = ratio * ux - x * bend, ratio * uy - y * bend
    q_behind = sqrt(1.0 + vx * vx + vy * vy)
    wx, wy = ux - x * turn, uy - y * turn
    across = wx * wx + wy * wy
    arrived = divide(x * (ux + wx) + y * (uy + wy), sqrt(1.0 + across) + q)
    left = divide(
        x * (vx + ratio * wx) + y * (vy + ratio * wy), sqrt(1.0 + ratio * ratio * across) + q_behind
    )
    cosine = divide(1.0, q_behind)
    return vx * cosine, vy * cosine, sense * cosine, index * (divide(left, ratio) - arrived)


def ideal_lens_adjoint(
    cotangents: Any, p: Any, x: Number, y: Number, l: Number, m: Number, n: Number,  # noqa: E741
    index: Number, inverse: Number, ratio: Number, sense: Number,
    a: Number, b: Number, c: Number, path: Number,
) -> tuple[Number, Number, Number, Number, Number, Number, Number]:  # fmt: skip
    """Return the cotangents of x, y, the direction and both indices: the chain rule, line by line
    from the last line of `ideal_lens_forward`.
    """
    power, vergence = p
    per_behind = ratio * inverse
    behind, bend, turn = divide(index, ratio), power * per_behind, vergence * inverse
    q = divide(1.0, where(n < 0.0, -n, n))
    ux, uy = l * q, m * q
    vx, vy = ratio * ux - x * bend, ratio * uy - y * bend
    q2 = sqrt(1.0 + vx * vx + vy * vy)
    wx, wy = ux - x * turn, uy - y * turn
    across = wx * wx + wy * wy
    q0, q02 = sqrt(1.0 + across), sqrt(1.0 + ratio * ratio * across)
    first, second = divide(1.0, q0 + q), divide(1.0, q02 + q2)
    arrived = (x * (ux + wx) + y * (uy + wy)) * first
    left = (x * (vx + ratio * wx) + y * (vy + ratio * wy)) * second

    cosine = divide(1.0, q2)
    of_s1, of_s2 = -path * index * first, path * behind * second
    of_q2 = -(a * vx + b * vy + c * sense) * cosine * cosine - of_s2 * left
    # Twice the cotangent of w².
    of_across = -divide(of_s1 * arrived, q0) - divide(of_s2 * left * ratio * ratio, q02)
    of_wx = (of_s1 + of_s2 * ratio) * x + of_across * wx
    of_wy = (of_s1 + of_s2 * ratio) * y + of_across * wy
    of_vx = a * cosine + of_s2 * x + of_q2 * vx * cosine
    of_vy = b * cosine + of_s2 * y + of_q2 * vy * cosine
    # w = u - r·V/n, and u' = μ·u - r·φ/n'.
    of_turn, of_bend = -(x * of_wx + y * of_wy), -(x * of_vx + y * of_vy)
    put(cotangents, 0, of_bend * per_behind)
    put(cotangents, 1, of_turn * inverse)
    of_ratio = of_s2 * (x * wx + y * wy) - divide(of_s2 * left * ratio * across, q02)
    of_ratio = of_ratio + ux * of_vx + uy * of_vy
    of_ux = of_s1 * x + of_wx + ratio * of_vx
    of_uy = of_s1 * y + of_wy + ratio * of_vy
    of_q = l * of_ux + m * of_uy - of_s1 * arrived
    return (
        of_s1 * (ux + wx) + of_s2 * (vx + ratio * wx) - turn * of_wx - bend * of_vx,
        of_s1 * (uy + wy) + of_s2 * (vy + ratio * wy) - turn * of_wy - bend * of_vy,
        of_ux * q,
        of_uy * q,
        -of_q * q * q * sense,
        (of_ratio * ratio - of_turn * turn) * inverse - path * arrived,
        path * left - (of_ratio * ratio + of_bend * bend) * per_behind,
    )


IDEAL_LENS = LawFunctions("ideal_lens", ideal_lens_forward, ideal_lens_adjoint, (None, None))


class IdealLens(Law):
    """The law of the ideal lens, in a plane: parameters `power` φ (1/mm) and `vergence` V (1/mm,
    zero if it is not there).
    """

    kind = "paraxial lens"
    kernel = LawKernel(IDEAL_LENS)
    rotational = True

    @classmethod
    def arriving(cls, p: Parameters, forward: bool) -> Number:
        """Return the reduced vergence (1/mm) of the light that arrives.

        Backwards, it comes from the image: n'/s' = φ - V.
        """
        vergence = p.get("vergence", 0.0)
        return vergence if forward else p["power"] - vergence

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
        """Change slopes and path; see the module."""
        before, (x, y, _) = media.before, point
        l, m, n, path = ideal_lens_forward(  # noqa: E741
            cls.numbers(p, travel.forward), x, y, *direction,
            before, 1.0 / before, before / media.behind, travel.behind,
        )  # fmt: skip
        return Deflected(l, m, n, None, path)

    @classmethod
    def numbers(cls, p: Parameters, forward: bool = True) -> tuple[Any, ...]:
        """Return the power and the reduced vergence of the light that arrives."""
        return p["power"], cls.arriving(p, forward)

    @classmethod
    def packed(cls, p: Parameters, forward: bool) -> PackedShape:
        """Return these; backwards the vergence is computed, and not stored."""
        return super().packed(p, forward)

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return φ at every wavelength."""
        return ParaxialPower(p["power"], 0.0)

    @classmethod
    def fourth_order_path(cls, p: Parameters) -> Number:
        """Return zero: the lens has no aberrations, and `seidel` passes it over."""
        return 0.0


@register_surface
class ParaxialLens(Plane):
    """The surface is a plane that deflects as an ideal lens of power φ (1/mm) in air; see
    `IdealLens`.
    """

    kind = "paraxial_lens"
    kernel = Plane.kernel
    law = IdealLens
    rotational = True
    closed_form = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the power."""
        if "power" not in keys:
            raise InputError("a paraxial lens needs 'power' (1/mm) or 'focal_length' (mm)")
        return ["power"]
