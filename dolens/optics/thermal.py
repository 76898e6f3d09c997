"""How indices change with temperature and pressure.

A catalogue's index is relative to air at the catalogue's reference temperature and at 1 atm.  At
another temperature the glass has another absolute index, and the air that the index is relative to
has changed as well.

The index of air is that of Edlén (Journal of the Optical Society of America 43 (1953) 339) at 15 °C
and 1 atm, carried to other temperatures and pressures as Kohlrausch does (Praktische Physik, 1968).
Schott's dn/dT constants are defined with it (TIE-19), and Zemax uses it.  Ciddor's formula
(Applied Optics 35 (1996) 1566) of dry air differs by less than 1e-7 from 0 to 40 °C in the visible.
"""

from dataclasses import dataclass
from typing import NamedTuple

from dolens.errors import InputError
from dolens.optics.dispersion import Wavelength

# °C and atm that indices hold for where nothing else is said.
STANDARD_TEMPERATURE, STANDARD_PRESSURE = 20.0, 1.0
# °C and 1/K of Kohlrausch's formula.
_EDLEN_TEMPERATURE, _EXPANSION_OF_AIR = 15.0, 3.4785e-3
_ABSOLUTE_ZERO = -273.15


class ThermalCoefficients(NamedTuple):
    """Schott's constants of dn/dT.

    Attributes:
        d0: 1/K.
        d1: 1/K².
        d2: 1/K³.
        e0: µm²/K.
        e1: µm²/K².
        resonance: µm, λtk; a negative one stands for a negative square.
        reference: °C, the temperature that the catalogue's index holds for.
    """

    d0: float
    d1: float
    d2: float
    e0: float
    e1: float
    resonance: float
    reference: float = STANDARD_TEMPERATURE


@dataclass(frozen=True)
class Environment:
    """The surroundings of a lens.

    Attributes:
        temperature: °C.
        pressure: atm; 0 is vacuum.

    Raises:
        InputError: the temperature is not above absolute zero, or the pressure is negative.
    """

    temperature: float = STANDARD_TEMPERATURE
    pressure: float = STANDARD_PRESSURE

    def __post_init__(self) -> None:
        # Written so that NaN is refused, too.
        if not _ABSOLUTE_ZERO < self.temperature <= 1e4:
            raise InputError(
                f"temperature {self.temperature:g} °C must be above {_ABSOLUTE_ZERO} °C and at "
                "most 10000 °C"
            )
        if not 0.0 <= self.pressure <= 1e3:
            raise InputError(f"pressure {self.pressure:g} atm must be from 0 to 1000 atm")


def air_index(wavelength: Wavelength, temperature: float, pressure: float) -> Wavelength:
    """Return the absolute index of dry air.

        n(15 °C, 1 atm) = 1 + 1e-8 (6432.8 + 2949810 λ²/(146 λ² - 1) + 25540 λ²/(41 λ² - 1))
        n - 1 = (n(15 °C, 1 atm) - 1) P / (1 + 3.4785e-3 (T - 15 °C))

    Args:
        wavelength: µm, a number or a tensor.
        temperature: °C.
        pressure: atm.
    """
    square = wavelength * wavelength
    refractivity = 1e-8 * (
        6432.8
        + 2949810.0 * square / (146.0 * square - 1.0)
        + 25540.0 * square / (41.0 * square - 1.0)
    )
    return 1.0 + refractivity * (
        pressure / (1.0 + _EXPANSION_OF_AIR * (temperature - _EDLEN_TEMPERATURE))
    )


def absolute_change(
    index: Wavelength, wavelength: Wavelength, thermal: ThermalCoefficients, temperature: float
) -> Wavelength:
    """Return by how much the absolute index of a glass exceeds that at its reference temperature.

        Δn = (n² - 1)/(2n) (D0 ΔT + D1 ΔT² + D2 ΔT³ + (E0 ΔT + E1 ΔT²)/(λ² - λtk²))

    with ΔT from the reference temperature: the integral of Schott's dn/dT (TIE-19, 2008).

    Args:
        index: of the glass at its reference temperature.
        wavelength: µm.
        thermal: the glass's constants.
        temperature: °C.
    """
    t = temperature - thermal.reference
    square = wavelength * wavelength - thermal.resonance * abs(thermal.resonance)
    bracket: Wavelength = t * (thermal.d0 + t * (thermal.d1 + t * thermal.d2))
    bracket = bracket + t * (thermal.e0 + t * thermal.e1) / square
    return (index * index - 1.0) / (2.0 * index) * bracket
