"""A catalogue glass: its refractive index at every wavelength, temperature and pressure.

A catalogue's index is relative to air at the catalogue's reference temperature and at 1 atm.  At
another temperature the glass has another absolute index, and the air that the index is relative to
has changed as well.

The index of air is that of Edlén (Journal of the Optical Society of America 43 (1953) 339) at 15 °C
and 1 atm, carried to other temperatures and pressures as Kohlrausch does (Praktische Physik, 1968).
Schott's dn/dT constants are defined with it (TIE-19), and Zemax uses it.  Ciddor's formula
(Applied Optics 35 (1996) 1566) of dry air differs by less than 1e-7 from 0 to 40 °C in the visible.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.dispersion import NM_PER_UM, Formula, Terms, Wavelength, extremes

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


# The ends of most ranges are spectral lines printed to four digits, for example h, 404.6561 nm, as
# 0.4047 µm: the line itself belongs to the range.
_ROUNDING = 2e-4


@dataclass(frozen=True)
class Glass:
    """A glass with its catalogue's dispersion formula.

    A catalogue's index is relative to air, so under an index model whose air is not 1 (`do`) it is
    multiplied by that air's: a surface in air bends light as the catalogue says in every model.

    Attributes:
        name: maker and name as the catalogue writes them, for example `SCHOTT:N-BK7`.
        formula: index from wavelength in µm, constant and terms.
        constant: first coefficient.
        terms: the other coefficients in pairs.
        wavelengths: nm, the first and the last for which the coefficients hold.
        air: index of the air that the formula's index is relative to, in the index model.
        thermal: how the index changes with temperature; None where the catalogue does not say.
        expansion: 1/K, linear; None where the catalogue does not say.
        environment: temperature and pressure; None: those of the catalogue.
        absorptions: rows of nm and 1/mm, from the internal transmittances of its catalogue.
    """

    name: str
    formula: Formula
    constant: float
    terms: Terms
    wavelengths: tuple[float, float]
    air: float = 1.0
    thermal: ThermalCoefficients | None = None
    expansion: float | None = None
    environment: Environment | None = None
    absorptions: tuple[tuple[float, float], ...] = ()

    def __hash__(self) -> int:
        # Names nearly always differ where glasses do; a trace looks media up in dictionaries.
        return hash(self.name)

    def at(self, environment: Environment | None) -> "Glass":
        """Return the same glass at another temperature and pressure."""
        return self if environment == self.environment else replace(self, environment=environment)

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Refractive index at a wavelength in nm, relative to the air around the lens.

        A number gives a number (in double precision, whatever the rays' precision);
        a tensor gives a tensor of its shape, computed in its precision, differentiable.

        The wavelength is that in air of the glass's environment, as Zemax takes it.

        Raises:
            InputError: a wavelength lies outside the catalogue's range, or the formula gives no
                index at a number.  Tensors are checked too,
                also within vmap, jvp and grad (on CUDA that waits for the device), but not
                while torch.compile traces or a CUDA graph is captured.
        """
        self._require_within_range(wavelength)
        try:
            index = self._index(wavelength / NM_PER_UM)
        except ZeroDivisionError:  # a resonance of the formula
            index = math.nan
        # The root of a negative square is complex to Python.
        if isinstance(index, complex) or (isinstance(index, float) and not 0.0 < index < math.inf):
            raise InputError(
                f"glass '{self.name}': its dispersion formula gives no index at {wavelength:g} nm"
            )
        return index

    def _index(self, micrometres: float | Tensor) -> float | Tensor:
        """Return what the formula gives in the glass's own environment."""
        reference = self.thermal.reference if self.thermal else STANDARD_TEMPERATURE
        here = self.environment
        if here is None or here == Environment(reference, STANDARD_PRESSURE):
            index = self.formula(micrometres, self.constant, self.terms)
        else:
            index = self._index_in(here, reference, micrometres)
        return index if self.air == 1.0 else self.air * index

    def _index_in(
        self, here: Environment, reference: float, micrometres: float | Tensor
    ) -> float | Tensor:
        """Return the index relative to air in surroundings other than the catalogue's."""
        air = air_index(micrometres, here.temperature, here.pressure)
        catalogue_air = air_index(micrometres, reference, STANDARD_PRESSURE)
        # The same light has this wavelength in the catalogue's air.
        light = micrometres * (air / catalogue_air)
        relative = self.formula(light, self.constant, self.terms)
        absolute = relative * catalogue_air
        if self.thermal:
            absolute = absolute + absolute_change(relative, light, self.thermal, here.temperature)
        return absolute / air

    def absorption(self, wavelength: float | Tensor) -> float | Tensor:
        """Return how fast light is absorbed, 1/mm, at wavelengths in nm; linear between the rows.

        It is zero where the catalogue gives none; see `knows_absorption`.
        """
        if not self.absorptions:
            return 0.0
        if not isinstance(wavelength, Tensor):
            return float(self.absorption(torch.tensor(wavelength, dtype=torch.float64)))
        options: Any = {"dtype": torch.float64, "device": wavelength.device}
        at, rate = torch.tensor(list(zip(*self.absorptions, strict=True)), **options)
        given = wavelength.detach().to(torch.float64)
        high = torch.bucketize(given.contiguous(), at).clamp(1, max(len(at) - 1, 1))
        low, high = high - 1, high.clamp(max=len(at) - 1)
        gap = at[high] - at[low]
        share = (given - at[low]) / gap.where(gap > 0.0, 1.0)
        found = rate[low] + share * (rate[high] - rate[low])
        inside = (given >= at[0]) & (given <= at[-1])
        return found.where(inside, 0.0).to(wavelength.dtype)

    def knows_absorption(self, wavelength: float) -> bool:
        """Return whether the catalogue gives internal transmittances around a wavelength (nm)."""
        rows = self.absorptions
        return bool(rows) and rows[0][0] <= wavelength <= rows[-1][0]

    def _require_within_range(self, wavelength: float | Tensor) -> None:
        first, last = self.wavelengths
        for value in extremes(wavelength):
            # Written so that NaN is outside, too.
            if not first * (1.0 - _ROUNDING) <= value <= last * (1.0 + _ROUNDING):
                raise InputError(
                    f"glass '{self.name}': wavelength {value:g} nm lies outside its range, "
                    f"{first:g} to {last:g} nm"
                )
