"""Refractive indices from nd and Vd, in the three index models of the reference material."""

import difflib
import math
import re
from dataclasses import dataclass

from torch import Tensor

from dolens.errors import InputError


@dataclass(frozen=True)
class IndexModel:
    """How a prescription's nd/Vd pairs and its air become indices.

    Attributes:
        name: as written in a prescription.
        lines: wavelengths in nm that stand for C, d and F in the two-term dispersion formula.
        air: index of air.
        occluder: index behind an aperture plane whose material is written `occluder`.
    """

    name: str
    lines: tuple[float, float, float]
    air: float
    occluder: float


INDEX_MODELS = {
    "dfc": IndexModel("dfc", (656.2725, 587.5618, 486.1327), 1.0, 1.0),
    "do": IndexModel("do", (656.3, 589.3, 486.1), 1.000293, 1.0),
    "paper": IndexModel("paper", (656.3, 589.3, 486.1), 1.0, 1.0),
}

_GLASS = re.compile(r"\s*(\d+(?:\.\d+)?)\s*/\s*(\d+(?:\.\d+)?)\s*")


@dataclass(frozen=True)
class Material:
    """A medium with index n(λ) = A + B/λ², λ in nm."""

    name: str
    a: float
    b: float = 0.0

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Refractive index at a wavelength in nm.

        A number gives a number (in double precision, whatever the rays' precision);
        a tensor gives a tensor of its shape.
        """
        if self.b == 0.0:
            return self.a
        return self.a + self.b / (wavelength * wavelength)


def index_model(name: str) -> IndexModel:
    """The index model of that name; raises `InputError` naming the allowed ones."""
    if name not in INDEX_MODELS:
        raise InputError(f"index_model '{name}' is unknown; allowed: {', '.join(INDEX_MODELS)}")
    return INDEX_MODELS[name]


def parse_material(text: str, model: IndexModel) -> Material:
    """Read a material as a prescription writes it.

    Args:
        text: `air`, `occluder`, or glass as nd/Vd, for example `1.5168/64.17`.
        model: which lines nd and Vd stand for, and the index of air.

    Returns:
        The material with B = (nd - 1)/Vd / (1/λF² - 1/λC²) and A = nd - B/λd².

    Raises:
        InputError: the text is none of these, or nd < 1, or Vd is not positive.
    """
    name = str(text).strip()
    if name.lower() == "air":
        return Material("air", model.air)
    if name.lower() == "occluder":
        return Material("occluder", model.occluder)
    match = _GLASS.fullmatch(name)
    if match is None:
        near = difflib.get_close_matches(name.lower(), ["air", "occluder"], n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise InputError(
            f"unknown material '{name}'{hint} "
            "(allowed: air, occluder, or glass as nd/Vd, for example 1.5168/64.17)"
        )
    nd, vd = float(match[1]), float(match[2])
    if nd < 1.0 or vd <= 0.0 or not math.isfinite(nd * vd):
        raise InputError(f"material '{name}': nd must be at least 1 and Vd positive")
    line_c, line_d, line_f = model.lines
    b = (nd - 1.0) / vd / (1.0 / line_f**2 - 1.0 / line_c**2)
    return Material(name, nd - b / line_d**2, b)
