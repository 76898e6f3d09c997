"""Even aspheres: a conic plus powers of r² (S1, S2)."""

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.surfaces.base import Hit, Parameters, PlaneRay, newton
from dolens.optics.surfaces.conic import Conic, conic_distance, conic_sag

_POWER = re.compile(r"a([1-9]\d*)")


class EvenAsphere(Conic):
    """s(r) = conic + a4·r⁴ + a6·r⁶ + ..., coefficients in mm^(1 - power)."""

    kind = "even_asphere"

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Curvature, conic constant and the coefficients that the prescription names."""
        powers = []
        for key in keys:
            match = _POWER.fullmatch(str(key))
            if match is None:
                continue
            power = int(match[1])
            if power < 4 or power % 2:
                raise InputError(f"'{key}': even aspheric coefficients are a4, a6, a8, ...")
            powers.append(power)
        return ["curvature", "conic", *(f"a{power}" for power in sorted(powers))]

    @classmethod
    def sag_and_gradient(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """Sag (S1) and slopes (S4), the polynomial by Horner's rule in r²."""
        r2 = x * x + y * y
        sag, slope, inside = conic_sag(p["curvature"], p["conic"], r2)
        powers = sorted(int(name[1:]) // 2 for name in p if _POWER.fullmatch(name))
        polynomial = torch.zeros_like(r2)
        derivative = torch.zeros_like(r2)
        for power in range(powers[-1] if powers else 0, 0, -1):
            derivative = derivative * r2 + polynomial
            polynomial = polynomial * r2
            if power in powers:
                polynomial = polynomial + p[f"a{2 * power}"]
        # The loop ends with polynomial = Σ a·r^(2i-2) and its derivative in r².
        slope = slope + polynomial + derivative * r2
        return sag + polynomial * r2, 2.0 * x * slope, 2.0 * y * slope, inside

    @staticmethod
    def start(p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """The conic's own intersection where there is one, else the vertex plane."""
        t, _, met = conic_distance(p["curvature"], p["conic"], ray, sense)
        return torch.where(met, t, torch.zeros_like(t))

    @classmethod
    def intersect(cls, p: Parameters, ray: PlaneRay, sense: float, scale: float) -> Hit:
        """Newton from the conic."""
        return newton(cls, p, ray, sense, scale)
