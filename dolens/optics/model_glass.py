"""Glass by nd, Vd and ΔPgF: a model of a glass that no catalogue lists.

A glass's partial dispersion PgF = (ng - nF)/(nF - nC) lies near Schott's normal line, through the
glasses K7 and F2, and ΔPgF is its distance from that line:

    PgF = 0.6438 - 0.001682 Vd + ΔPgF

Conrady's formula n = n0 + A/λ + B/λ^3.5 has three constants, and the model's are those that give
nd, nF - nC and PgF exactly.  Glasses of Schott and Ohara within 0.005 of the normal line, modelled
by nd and Vd alone (ΔPgF = 0), are met within 4e-5 from 480 to 656 nm and within 2e-4 at 436 nm.
A polynomial in 1/λ² through the same three numbers errs by three times as much.

Zemax's own formula for model glass is not published.  Its makers say that it takes nd, Vd and ΔPgF
from this normal line, and that it is accurate to about 1e-4 in the visible (Zemax Knowledge Base,
"How to Use the Model Glass", 2005).  So differences of that size are to be expected.  At the lines
themselves they are smaller: the foci that OpticStudio has written into 15 files are met within 1e-6
of the focal length here, and would be within 2e-8 if nd, nF and nC were those at 587.6, 486.1 and
656.3 nm.
"""

from dataclasses import dataclass

from torch import Tensor

from dolens.optics.dispersion import require_wavelength

# Mercury's g line, nm.
LINE_G = 435.8343
# Schott's normal line (TIE-29).
_NORMAL_OFFSET, _NORMAL_SLOPE = 0.6438, -0.001682
# Powers of λ in Conrady's formula.
_FIRST, _SECOND = -1.0, -3.5
_NM_PER_UM = 1000.0


@dataclass(frozen=True)
class ModelGlass:
    """A medium with index n(λ) = n0 + A/λ + B/λ^3.5, λ in µm.

    Attributes:
        name: nd/Vd/ΔPgF as a prescription writes it.
        constant: n0.
        a: µm.
        b: µm^3.5.
    """

    name: str
    constant: float
    a: float
    b: float

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Refractive index at a wavelength in nm.

        A number gives a number (in double precision, whatever the rays' precision);
        a tensor gives a tensor of its shape.

        Raises:
            InputError: the number is no wavelength of light.
        """
        require_wavelength(wavelength)
        micrometres = wavelength / _NM_PER_UM
        return self.constant + self.a * micrometres**_FIRST + self.b * micrometres**_SECOND


def normal_partial_dispersion(vd: float) -> float:
    """Return PgF of Schott's normal line at an Abbe number."""
    return _NORMAL_OFFSET + _NORMAL_SLOPE * vd


def deviation_of_two_terms(vd: float, lines: tuple[float, float, float]) -> float:
    """Return ΔPgF of the two-term formula A + B/λ² that nd/Vd alone stands for.

    Args:
        vd: Abbe number.
        lines: C, d and F in nm.
    """
    c, _, f = (line**-2 for line in lines)
    return (LINE_G**-2 - f) / (f - c) - normal_partial_dispersion(vd)


def model_glass(
    name: str, nd: float, vd: float, deviation: float, lines: tuple[float, float, float]
) -> ModelGlass:
    """Return the glass with this nd, Vd = (nd - 1)/(nF - nC) and ΔPgF.

    Args:
        name: of the medium.
        nd: index at the line d.
        vd: Abbe number, not 0.
        deviation: ΔPgF.
        lines: C, d and F in nm; g is 435.8343 nm.
    """
    c, d, f, g = (line / _NM_PER_UM for line in (*lines, LINE_G))
    dispersion = (nd - 1.0) / vd
    partial = (normal_partial_dispersion(vd) + deviation) * dispersion
    # A u + B v over (C, F) is nF - nC, and over (F, g) it is ng - nF.
    u1, v1 = f**_FIRST - c**_FIRST, f**_SECOND - c**_SECOND
    u2, v2 = g**_FIRST - f**_FIRST, g**_SECOND - f**_SECOND
    determinant = u1 * v2 - u2 * v1
    a = (dispersion * v2 - partial * v1) / determinant
    b = (u1 * partial - u2 * dispersion) / determinant
    return ModelGlass(name, nd - a * d**_FIRST - b * d**_SECOND, a, b)
