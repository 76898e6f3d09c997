"""A glass of a catalogue: its index at every wavelength, temperature and pressure."""

import math
from dataclasses import dataclass, replace

from torch import Tensor

from dolens.errors import InputError
from dolens.optics.dispersion import Formula, Terms, extremes
from dolens.optics.thermal import (
    STANDARD_PRESSURE,
    STANDARD_TEMPERATURE,
    Environment,
    ThermalCoefficients,
    absolute_change,
    air_index,
)

_NM_PER_UM = 1000.0
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
            index = self._index(wavelength / _NM_PER_UM)
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

    def _require_within_range(self, wavelength: float | Tensor) -> None:
        first, last = self.wavelengths
        for value in extremes(wavelength):
            # Written so that NaN is outside, too.
            if not first * (1.0 - _ROUNDING) <= value <= last * (1.0 + _ROUNDING):
                raise InputError(
                    f"glass '{self.name}': wavelength {value:g} nm lies outside its range, "
                    f"{first:g} to {last:g} nm"
                )
