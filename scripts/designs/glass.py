"""Hartmann's formula through nd, Vd and the partial dispersion, as others take it for a glass."""

from dataclasses import dataclass

from torch import Tensor

from dolens.optics.dispersion import normal_partial_dispersion

# nm, as rounded there: C, d, F, g.
_C, _D, _F, _G = 656.3, 587.6, 486.1, 435.8


@dataclass(frozen=True)
class HartmannGlass:
    """A medium with index n(λ) = A + S/(λ - B), λ in nm.

    Attributes:
        name: nd/Vd/ΔPgF.
        constant: A.
        strength: S, nm.
        pole: B, nm.
    """

    name: str
    constant: float
    strength: float
    pole: float

    @staticmethod
    def of(nd: float, vd: float, deviation: float = 0.0) -> "HartmannGlass":
        """Return the glass whose nd, nF - nC and (ng - nF)/(nF - nC) are given.

        Args:
            nd: at 587.6 nm.
            vd: (nd - 1)/(nF - nC).
            deviation: of the partial dispersion from Schott's normal line.
        """
        partial = normal_partial_dispersion(vd) + deviation
        # Both differences of indices are S times one of 1/(λ - B).
        long, short = _C - _F, _F - _G
        pole = (short * _C - partial * long * _G) / (short - partial * long)
        strength = (nd - 1.0) / vd * (_F - pole) * (_C - pole) / long
        return HartmannGlass(f"{nd}/{vd}/{deviation}", nd - strength / (_D - pole), strength, pole)

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Return the refractive index at a wavelength, nm: a number, or a tensor of its shape."""
        return self.constant + self.strength / (wavelength - self.pole)
