"""What a catalogue says of its glasses besides their indices: status, price, density, resistance.

The tables that come with dolens hold indices, dn/dT and expansion alone.  The rest is read from a
maker's `.agf` file in the user's folders (see `dolens.optics.glass_catalog`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dolens.errors import InputError
from dolens.optics.agf import RESISTANCES, AgfEntry, read_entry
from dolens.optics.dispersion import NM_PER_UM
from dolens.optics.glass import STANDARD_TEMPERATURE, Glass, absolute_change
from dolens.optics.glass_catalog import (
    FURTHER,
    MAKERS,
    catalogues,
    suggestion,
    table,
    table_glass,
    user_catalogues,
    user_entries,
    user_glass,
)
from dolens.optics.materials import LINE_D

# K; the absolute index is a polynomial of the third degree in the temperature.
_SMALL_STEP = 0.01


@dataclass(frozen=True)
class CatalogueGlass:
    """A glass with what its catalogue says of it; None stands for what it does not say.

    Attributes:
        glass: in its own environment.
        status: `standard`, `preferred`, `obsolete`, `special`, `melt`, `inquiry`, `experimental`.
        price: relative to the maker's N-BK7 or its like.
        density: g/cm³.
        resistances: CR, FR, SR, AR, PR → class; a low class is good.
        dn_dt: 1/K, of the absolute index at the d line and 20 °C.
    """

    glass: Glass
    status: str | None = None
    price: float | None = None
    density: float | None = None
    resistances: Mapping[str, float] = field(default_factory=dict, hash=False)
    dn_dt: float | None = None

    def value(self, name: str) -> float | None:
        """Return `price`, `density`, `dn_dt` or one of CR, FR, SR, AR, PR."""
        if name in RESISTANCES:
            return self.resistances.get(name)
        values = {"price": self.price, "density": self.density, "dn_dt": self.dn_dt}
        return values[name]


def catalogue_glasses(catalogue: str) -> list[CatalogueGlass]:
    """Return all glasses of a catalogue, those of a user's file before those of the table.

    An entry of a user's file that cannot be read is passed over here; `find_glass` says what is
    wrong with it.

    Raises:
        InputError: there is no catalogue of that name, or its file cannot be read.
    """
    known = catalogues()
    name = "".join(catalogue.upper().split())
    if name not in known:
        raise InputError(
            f"no glass catalogue '{catalogue}'{suggestion(name, known)} "
            f"(allowed: {', '.join(known)})"
        )
    own = user_catalogues()
    entries = user_entries(own[name]) if name in own else {}
    found = [glass for entry in entries.values() if (glass := _of_entry(name, entry))]
    if name in MAKERS + FURTHER:
        found += [_of_glass(table_glass(name, key)) for key in table(name) if key not in entries]
    return found


def _of_entry(catalogue: str, entry: AgfEntry) -> CatalogueGlass | None:
    try:
        printed = read_entry(entry)
    except InputError:
        return None
    glass = user_glass(catalogue, entry)
    return CatalogueGlass(
        glass,
        printed.status or None,
        printed.price,
        printed.density,
        dict(printed.resistances),
        _dn_dt(glass),
    )


def _of_glass(glass: Glass) -> CatalogueGlass:
    return CatalogueGlass(glass, dn_dt=_dn_dt(glass))


def _dn_dt(glass: Glass) -> float | None:
    if glass.thermal is None:
        return None
    try:
        index = glass.index(LINE_D)
    except InputError:  # the range of wavelengths has no d line
        return None
    warm, cold = (
        absolute_change(index, LINE_D / NM_PER_UM, glass.thermal, STANDARD_TEMPERATURE + step)
        for step in (_SMALL_STEP, -_SMALL_STEP)
    )
    return float(warm - cold) / (2.0 * _SMALL_STEP)
