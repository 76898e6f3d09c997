"""Zemax's files of gradient-index glasses, GRADIENT_9.DAT and GLC.DAT, in a folder of glasses.

Both are lists of blocks of lines, the name of a glass and a number on each line below it::

    SLW-1.8     # GRADIENT_9.DAT of surfaces GRINSUR9, for λ in µm and mm: B, C, K0, K1, K2
    ARS20       # GLC.DAT of GRINSUR6, for λ in nm and mm: A, B, C, D of n0, then those of n1 to n4

with

    GRINSUR9:  n = n0·(1 - A·r²/2),  n0 = B + C/λ²,  A = (K0 + K1/λ² + K2/λ⁴)²
    GRINSUR6:  n = n0 + n1·r² + n2·r⁴ + n3·r⁶ + n4·r⁸,  each A + B·λ² + C/λ² + D/λ⁴

A first line `VERSION 1` is passed over.  The files of OpticStudio come with it, and not with
dolens.

Source: OpticStudio's help, "Gradient 6" and "Gradient 9"; the formulas of SELFOC glasses are
NSG's.  SGRIN.DAT, which gives other gradients a dispersion, is not read.
"""

import re
from functools import lru_cache
from pathlib import Path

from dolens.errors import InputError
from dolens.files import decode_text, read_file
from dolens.optics.glass_catalog import user_file
from dolens.optics.gradients import Gradient
from dolens.optics.wavelength_series import WavelengthSeries, series_of
from dolens.prescriptions.numbers import number_in_text

_LARGEST = 2**20
# TYPE → file, and numbers of a glass in it.
FILES = {"GRINSUR6": ("GLC.DAT", 20), "GRINSUR9": ("GRADIENT_9.DAT", 5)}
_NM = 1e3


def gradient_glass(kind: str, name: str, place: str) -> str:
    """Return the medium behind a surface as a prescription writes it.

    Args:
        kind: one of `FILES`.
        name: of the glass, in any case.
        place: name of the surface in messages.

    Raises:
        InputError: there is no such file, or it cannot be read, or lacks the glass.
    """
    file, count = FILES[kind]
    path = user_file(file)
    if path is None:
        raise InputError(
            f"{place}: the gradient-index glass {name} stands in Zemax's {file}; name its folder "
            "in glass_catalogues or DOLENS_GLASS"
        )
    state = path.stat()
    found = _glasses(path, count, state.st_mtime_ns, state.st_size)
    if name.upper() not in found:
        raise InputError(
            f"{place}: {path} has no glass {name} (allowed: {', '.join(found) or 'none'})"
        )
    numbers = found[name.upper()]
    medium = _selfoc(*numbers) if kind == "GRINSUR9" else _of_lens_maker(numbers)
    return medium.name


def _selfoc(b: float, c: float, k0: float, k1: float, k2: float) -> Gradient:
    n0 = WavelengthSeries(b, ((c, -2),))
    root = WavelengthSeries(k0, ((k1, -2), (k2, -4)))
    r2 = n0.times(root.times(root)).times(WavelengthSeries(-0.5))
    return _gradient(n0, (r2,))


def _of_lens_maker(numbers: tuple[float, ...]) -> Gradient:
    series = [
        series_of({0: a, 2: b * _NM**2, -2: c / _NM**2, -4: d / _NM**4})
        for a, b, c, d in zip(*(numbers[k::4] for k in range(4)), strict=True)
    ]
    return _gradient(series[0], tuple(series[1:]))


def _gradient(base: WavelengthSeries, radial: tuple[WavelengthSeries, ...]) -> Gradient:
    named = [(f"r{2 * k}", series) for k, series in enumerate(radial, 1)]
    named = [(term, series) for term, series in named if series.constant or series.terms]
    terms = tuple((term, series.constant) for term, series in named)
    return Gradient(base, terms, False, tuple((t, s.terms) for t, s in named if s.terms))


# The time and size of the file are part of the key: an edited file is read again.
@lru_cache(maxsize=16)
def _glasses(path: Path, count: int, changed: int, size: int) -> dict[str, tuple[float, ...]]:
    """Return name in capitals → numbers of a file's glasses."""
    text = decode_text(read_file(path, _LARGEST, "file of gradient-index glasses"), str(path))
    lines = [(at, line.strip()) for at, line in enumerate(text.splitlines(), 1) if line.strip()]
    if lines and re.match(r"VERSION\b", lines[0][1], re.IGNORECASE):
        lines = lines[1:]
    found: dict[str, tuple[float, ...]] = {}
    for first in range(0, len(lines), count + 1):
        (_, name), *block = lines[first : first + count + 1]
        if len(block) < count:
            raise InputError(f"{path}: '{name}' has {len(block)} numbers, not {count}")
        found[name.upper()] = tuple(
            number_in_text(words.split()[0], f"{path}: line {at}") for at, words in block
        )
    return found
