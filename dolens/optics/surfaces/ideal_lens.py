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

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.limits import GRAZING
from dolens.kernels.surface_kernel import LawKernel
from dolens.optics.surfaces.base import Parameters
from dolens.optics.surfaces.deflection import (
    Deflected,
    Law,
    Media,
    Number,
    ParaxialPower,
    Travel,
    Vector,
)
from dolens.optics.surfaces.plane import Plane
from dolens.optics.surfaces.registry import register_surface


class IdealLens(Law):
    """The law of the ideal lens, in a plane: parameters `power` φ (1/mm) and `vergence` V (1/mm,
    zero if it is not there).
    """

    kind = "paraxial lens"
    kernel = LawKernel("dolens.kernels.cpu.ideal_lens", "dolens.kernels.cuda.ideal_lens")
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
        """Change slopes and path; see the module.  Slopes count along the light's own sense."""
        x, y, _ = point
        l, m, n = direction  # noqa: E741
        before, behind = media.before, media.behind
        power, ratio = p["power"], before / behind
        q = 1.0 / n.abs().clamp(min=GRAZING)
        ux, uy = l * q, m * q
        vx, vy = ratio * ux - x * (power / behind), ratio * uy - y * (power / behind)
        q_behind = torch.sqrt(1.0 + vx * vx + vy * vy)
        turn = cls.arriving(p, travel.forward) / before
        wx, wy = ux - x * turn, uy - y * turn
        across = wx * wx + wy * wy
        centre = torch.sqrt(1.0 + across)
        centre_behind = torch.sqrt(1.0 + (ratio * ratio) * across)
        arrived = (x * (ux + wx) + y * (uy + wy)) / (centre + q)
        left = (x * (vx + ratio * wx) + y * (vy + ratio * wy)) / (centre_behind + q_behind)
        return Deflected(
            vx / q_behind,
            vy / q_behind,
            travel.sense / q_behind,
            None,
            behind * left - before * arrived,
        )

    @classmethod
    def packed(cls, p: Parameters, forward: bool) -> tuple[Tensor, ...]:
        """Return the power and the reduced vergence of the light that arrives."""
        return p["power"], torch.as_tensor(cls.arriving(p, forward)).to(p["power"])

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
