"""Media as a prescription names them: air, a constant index, nd and Vd, a glass, or a mirror.

`docs/glass.md` explains the names and the formulas behind them.  A mirror stands in the place of
the medium behind a surface, and light goes back into the medium that it came from.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeGuard

from torch import Tensor

from dolens.errors import InputError, check_choice, comma_hint, did_you_mean
from dolens.optics.crystals import RAYS, Uniaxial
from dolens.optics.dispersion import ModelGlass, model_glass, require_wavelength
from dolens.optics.glass import Environment, Glass
from dolens.optics.glass_catalog import find_glass
from dolens.optics.gradients import MOST_POWERS, RADIAL, TERMS, Gradient
from dolens.optics.wavelength_series import parse_series


class Mirror:
    """A mirror is written where other surfaces have the medium behind them.

    There is one, `MIRROR`.  Light stays in the medium in front of the surface, and travels the
    other way along z behind it; so thicknesses behind one mirror are negative.
    """

    name = "mirror"

    def index(self, wavelength: object) -> float:
        """Raise `InputError`: the index is that of the medium in front of the mirror."""
        raise InputError("a mirror has no index; the medium behind it is the one in front of it")

    def __repr__(self) -> str:
        """Return its name."""
        return self.name

    def __copy__(self) -> "Mirror":
        """Return itself: there is one."""
        return self

    def __deepcopy__(self, memo: object) -> "Mirror":
        """Return itself: there is one."""
        return self

    def __reduce__(self) -> str:
        """Name the one mirror, for pickles."""
        return "MIRROR"


MIRROR = Mirror()


class Media(NamedTuple):
    """The media that light travels in, and the surfaces that reflect it.

    Attributes:
        materials: before surface 1 and behind each surface; behind a mirror, the one in front.
        mirrors: numbers of the surfaces that reflect, from 1.
    """

    materials: tuple[Any, ...]
    mirrors: tuple[int, ...]


def media_of(materials: Sequence[Any]) -> Media:
    """Resolve the mirrors in a lens's materials.

    Args:
        materials: before surface 1 and behind each surface; `MIRROR` behind one that reflects.

    Raises:
        InputError: there is a mirror before surface 1.
    """
    if materials[0] is MIRROR:
        raise InputError("the object cannot be in a mirror: 'object_material' is a medium")
    found, mirrors = [materials[0]], []
    for number, material in enumerate(materials[1:], 1):
        if material is MIRROR:
            mirrors.append(number)
        found.append(found[-1] if material is MIRROR else material)
    return Media(tuple(found), tuple(mirrors))


@dataclass(frozen=True)
class IndexModel:
    """A model of indices: of a prescription's nd/Vd pairs, and of its air.

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

# Wavelengths of the Fraunhofer lines that nd and Vd are defined on, nm.
LINE_C, LINE_D, LINE_F = INDEX_MODELS["dfc"].lines

_DECIMAL = r"\s*(\d+(?:\.\d+)?)\s*"
_SIGNED = r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*"
_GLASS = re.compile(f"{_DECIMAL}/{_DECIMAL}(?:/{_SIGNED})?", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
_CRYSTAL = re.compile(
    rf"(?P<medium>\S.*?)\s+(?P<ray>{'|'.join(RAYS)})\b(?P<axis>.*)", re.IGNORECASE | re.DOTALL
)
# No optical medium is denser; the bound also catches a wavelength or a glass code.  Vacuum has
# 0.9997 relative to air, and some crystals in the infrared have less than 1.
_LOWEST_INDEX, _HIGHEST_INDEX = 0.1, 10.0
# Of ΔPgF: catalogue glasses deviate from the normal line by less than 0.1.
LARGEST_DEVIATION = 1.0


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

        Raises:
            InputError: the number is no wavelength of light.
        """
        require_wavelength(wavelength)
        if self.b == 0.0:
            return self.a
        return self.a + self.b / (wavelength * wavelength)


# What light may travel through: hashable, equal when it is the same medium, and with a name that a
# prescription reads back as the same.
Medium = Material | ModelGlass | Glass | Mirror | Uniaxial | Gradient

# Names of what stands for a medium and is none but air.
NO_GLASS = ("air", "occluder", MIRROR.name)


def index_model(name: str) -> IndexModel:
    """The index model of that name; raises `InputError` naming the allowed ones."""
    check_choice(name, INDEX_MODELS, "index_model")
    return INDEX_MODELS[name]


def parse_material(text: str, model: IndexModel, environment: Environment | None = None) -> Medium:
    """Read a material as a prescription writes it.

    Args:
        text: `air`; `occluder`; `mirror`, where a surface reflects; a number, the same index at
            every wavelength; glass as nd/Vd, for example `1.5168/64.17`, or as nd/Vd/ΔPgF (see
            `model_glass`); a catalogue glass, for example `N-BK7` or `SCHOTT:N-BK7` (see
            `find_glass`); one of these with a gradient, for example `gradient 1.6 r2=-0.001` (see
            `Gradient`); or a uniaxial crystal, for example `CALCITE extraordinary 0 1 1` (see
            `Uniaxial`): the medium of its ordinary rays, which ray is followed, and the direction
            of its optic axis.  The medium of extraordinary rays has the name with `-E` behind it,
            or stands behind `and`: `1.658 and 1.486 ordinary 0 1 0`.  Case is ignored.
        model: which lines nd and Vd stand for, and the index of air.  A constant index, nd/Vd and
            nd/Vd/ΔPgF are taken as written; a catalogue glass is relative to air (see `Glass`).
        environment: temperature and pressure of a catalogue glass; None: those of its catalogue.
            Other media are relative to the air around the lens, and stay as they are written.

    Returns:
        The medium; of nd/Vd the one with B = (nd - 1)/Vd / (1/λF² - 1/λC²) and A = nd - B/λd².

    Raises:
        InputError: the text is none of these, or a name that several makers gave (see
            `find_glass`), or the number is not from 0.1 to 10, or nd is not, or Vd is not positive.
    """
    name = str(text).strip()
    crystal = _CRYSTAL.fullmatch(name)
    if crystal is not None:
        return _crystal(crystal, model, environment)
    if name.lower() == "air":
        return Material("air", model.air)
    if name.lower() == "occluder":
        return Material("occluder", model.occluder)
    if _NUMBER.fullmatch(name):
        return _constant(name)
    if name.lower() == MIRROR.name:
        return MIRROR
    if name.lower().split(maxsplit=1)[:1] in (["gradient"], ["gradient_squared"]):
        return _gradient(name, model, environment)
    match = _GLASS.fullmatch(name)
    if comma_hint(name):
        raise InputError(f"material '{name}' must have numbers{comma_hint(name)}")
    if match is None:
        return find_glass(name, model.air, environment)
    nd, vd = float(match[1]), float(match[2])
    if not _LOWEST_INDEX <= nd <= _HIGHEST_INDEX or vd <= 0.0 or not math.isfinite(vd):
        raise InputError(f"material '{name}': nd must be from 0.1 to 10 and Vd positive")
    if match[3] is not None:
        return _with_partial_dispersion(name, nd, vd, float(match[3]), model)
    line_c, line_d, line_f = model.lines
    b = (nd - 1.0) / vd / (1.0 / line_f**2 - 1.0 / line_c**2)
    return Material(name, nd - b / line_d**2, b)


def absorption(medium: Medium, wavelength: float | Tensor) -> float | Tensor:
    """Return how fast light is absorbed in a medium, 1/mm: I = I₀·exp(-a·t), at wavelengths in nm.

    It is zero where no catalogue gives an internal transmittance.  Of a crystal it is that of the
    ray that is followed.
    """
    if isinstance(medium, Uniaxial):
        medium = medium.followed
    return medium.absorption(wavelength) if isinstance(medium, Glass) else 0.0


def is_anisotropic(medium: Medium) -> TypeGuard[Uniaxial]:
    """Return whether light goes through a medium as extraordinary rays."""
    return isinstance(medium, Uniaxial) and medium.anisotropic


def is_glass(medium: Medium) -> bool:
    """Return whether light is in a solid or liquid there: not in air, and not at a mirror."""
    return medium.name not in NO_GLASS


def index_d(medium: Medium) -> float:
    """nd: the index at the d line of helium, 587.5618 nm."""
    return float(medium.index(LINE_D))


def abbe_number(medium: Medium) -> float:
    """Vd = (nd - 1)/(nF - nC) at 587.5618, 486.1327 and 656.2725 nm; inf without dispersion."""
    dispersion = float(medium.index(LINE_F)) - float(medium.index(LINE_C))
    return math.inf if dispersion == 0.0 else (index_d(medium) - 1.0) / dispersion


def _crystal(found: re.Match[str], model: IndexModel, environment: Environment | None) -> Uniaxial:
    text, ray = found[0], found["ray"].lower()
    first, both, second = found["medium"].partition(" and ")
    if not both:
        # Catalogues that have the one ray alone are passed over.
        second = f"{first}-E"
        maker, _, _ = _part_of(text, second, model, environment).name.rpartition(":")
        first = f"{maker}:{first}" if maker and ":" not in first else first
    media = [_part_of(text, part, model, environment) for part in (first, second)]
    try:
        x, y, z = map(float, found["axis"].split())
        return Uniaxial(media[0], media[1], (x, y, z), ray)
    except ValueError:
        raise InputError(
            f"material '{text}': behind '{ray}' stand the three numbers of the optic axis, which "
            "are not all zero"
        ) from None


def _part_of(
    text: str, part: str, model: IndexModel, environment: Environment | None
) -> Material | ModelGlass | Glass:
    try:
        found = parse_material(part, model, environment)
    except InputError as error:
        raise InputError(f"material '{text}': {error}") from None
    if isinstance(found, Mirror | Uniaxial | Gradient):
        raise InputError(f"material '{text}': '{part}' is no medium with one index")
    return found


def _with_partial_dispersion(
    name: str, nd: float, vd: float, deviation: float, model: IndexModel
) -> ModelGlass:
    if not abs(deviation) <= LARGEST_DEVIATION:
        raise InputError(f"material '{name}': ΔPgF must be from -1 to 1 (glasses have about ±0.05)")
    return model_glass(name, nd, vd, deviation, model.lines)


_ALL_TERMS = f"{', '.join(RADIAL)}; x, x2 to x{MOST_POWERS}, and of y and z"


def _gradient(name: str, model: IndexModel, environment: Environment | None) -> Gradient:
    kind, *words = name.split()
    base = [word for word in words if "=" not in word]
    dispersions: list[tuple[str, Any]] = []
    if len(base) != 1 or len(words) < 2:
        raise InputError(
            f"material '{name}': write a medium and terms, such as gradient 1.6 r2=-0.001"
        )
    series = parse_series(base[0])
    varies = series is not None and series.terms
    medium: Any = series if varies else _part_of(name, base[0], model, environment)
    terms: dict[str, float] = {}
    for word in words:
        term, equals, value = word.lower().partition("=")
        if not equals:
            continue
        if term not in TERMS or term in terms:
            what = f"'{term}' is there twice" if term in terms else f"there is no term '{term}'"
            raise InputError(
                f"material '{name}': {what}{did_you_mean(term, TERMS)} (allowed: {_ALL_TERMS})"
            )
        series = parse_series(value)
        if series is None:
            raise InputError(
                f"material '{name}': {term} must be a number, not '{value}', or a series such as "
                "-0.05+1e-4/w2 with the wavelength w in µm"
            )
        terms[term] = series.constant
        if series.terms:
            dispersions.append((term, series.terms))
    ordered = tuple((term, terms[term]) for term in TERMS if term in terms)
    return Gradient(medium, ordered, kind.lower() == "gradient_squared", tuple(dispersions))


def _constant(text: str) -> Material:
    index = float(text)
    if not _LOWEST_INDEX <= index <= _HIGHEST_INDEX:
        raise InputError(f"material '{text}': a constant index must be from 0.1 to 10")
    # Written one way, so that 1.5 and 1.50 are the same medium.
    return Material(repr(index), index)
