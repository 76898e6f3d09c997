"""The catalogues that come with dolens: one table of glasses a maker, in `glass_data`.

Each table is a CSV file with a row a glass: name, dispersion formula (a function of
`dolens.optics.dispersion`), its constant, its terms in pairs, the range of wavelengths in µm,
D0 D1 D2 E0 E1 λtk and the reference temperature (see `dolens.optics.thermal`), the expansion from
-30 to 70 °C in 1e-6/K, and the source.  Coefficients have every digit that the makers print.
"""

import csv
import io
from functools import cache
from importlib import resources
from typing import Any

from dolens.errors import InputError
from dolens.optics import dispersion
from dolens.optics.glass import Glass
from dolens.optics.thermal import ThermalCoefficients

# The makers whose names mean their glasses without saying so, in the order of messages; and the
# others, whose glasses a bare name means where none of those has it.
MAKERS = ("SCHOTT", "OHARA", "HOYA", "CDGM", "SUMITA", "HIKARI", "PLASTIC")
FURTHER = (
    *("MISC", "INFRARED", "SCHOTT_IG", "CORNING", "HERAEUS", "LZOS", "EYE", "BIREFRINGENT"),
    *("LIGHTPATH", "RPO", "NHG", "PILKINGTON", "ARCHER", "TOPAS", "ZEON", "UMICORE"),
    *("ISUZU", "RAD_HARD"),
)
_FORMULAS = {
    formula.__name__: formula
    for formula in (
        dispersion.sellmeier,
        dispersion.sellmeier_squared,
        dispersion.sellmeier_with_offset,
        dispersion.sellmeier_with_pole,
        dispersion.pole_and_powers,
        dispersion.resonance_and_powers,
        dispersion.polynomial,
        dispersion.cauchy,
        dispersion.herzberger,
    )
}
_NM_PER_UM = 1000.0
# The source of the names that mean a maker's glass wherever no other maker here has them: the
# catalogues of 2013 to 2022 in refractiveindex.info's database.
_MAIN_SOURCE = "rii"


def is_main(maker: str, key: str) -> bool:
    """Tell whether a bare name may mean a maker's glass before those of other editions.

    Schott's old glasses are among them: files name them without saying whose they are.
    """
    return maker == "SCHOTT" or table(maker)[key]["source"] == _MAIN_SOURCE


@cache
def table(maker: str) -> dict[str, dict[str, str]]:
    """Return name in capitals → row of a maker's table.

    Raises:
        InputError: no table is of that maker.
    """
    if maker not in MAKERS + FURTHER:
        raise InputError(f"no maker '{maker}' (allowed: {', '.join(MAKERS + FURTHER)})")
    file = resources.files("dolens.optics").joinpath("glass_data", f"{maker.lower()}.csv")
    rows = csv.DictReader(io.StringIO(file.read_text(encoding="ascii"), newline=""))
    return {row["name"].upper(): row for row in rows}


def table_glass(maker: str, key: str) -> Glass:
    """Return the glass of a maker's table under that name in capitals, in its own environment."""
    row: dict[str, Any] = table(maker)[key]
    first, last = (round(_NM_PER_UM * float(word), 6) for word in row["range_um"].split())
    thermal = [float(word) for word in row["thermal"].split()]
    return Glass(
        f"{maker}:{row['name']}",
        _FORMULAS[row["formula"]],
        float(row["constant"]),
        _pairs(row["terms"]),
        (first, last),
        thermal=ThermalCoefficients(*thermal) if thermal else None,
        expansion=1e-6 * float(row["expansion"]) if row["expansion"] else None,
    )


def _pairs(text: str) -> tuple[tuple[float, float], ...]:
    values = [float(word) for word in text.split()]
    return tuple(zip(values[::2], values[1::2], strict=True))
