"""Writes the tables of dolens/optics/glass_data from the catalogues that glass makers publish.

    python scripts/glass_tables.py --database refractiveindex.info-database/database/data \\
        --catalogue SCHOTT schott2025 SCHOTT-2025-06.AGF --catalogue SCHOTT schott2012 SCHOTT.AGF

The first source that has a glass gives it: refractiveindex.info's database (public domain, the
catalogues of 2013 to 2022 with all printed digits), then the catalogues in the order named.  Each
row names its source.  A row whose nd is not the one that the catalogue prints is left out, and
printed.
"""

import argparse
import csv
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dolens.errors import InputError
from dolens.files import decode_text
from dolens.optics.agf import parse_agf, read_entry
from dolens.optics.dispersion import Formula, cauchy, polynomial, sellmeier, sellmeier_squared

TABLES = Path(__file__).parents[1] / "dolens" / "optics" / "glass_data"
HEADINGS = ("name", "formula", "constant", "terms", "range_um", "thermal", "expansion", "source")
# Maker → folders of the database.
FOLDERS = {
    "SCHOTT": ("specs/schott/optical", "specs/schott/misc", "specs/schott/infrared"),
    "OHARA": ("specs/ohara/optical",),
    "HOYA": ("specs/hoya/optical",),
    "CDGM": ("specs/cdgm/optical",),
    "SUMITA": ("specs/sumita/optical",),
    "HIKARI": (
        *("specs/hikari/optical", "specs/hikari/CaF", "specs/hikari/SiO2", "specs/hikari/i-line"),
    ),
}
# Names that earlier versions of dolens took from the database's index, where they are misspelt.
MISSPELT = {
    "P-FK2S": ("HIKARI", "specs/hikari/optical/P-FKH2S.yml"),
    "Q-FK2S": ("HIKARI", "specs/hikari/optical/Q-FKH2S.yml"),
}
# One measurement a plastic.  Batches differ by about 1e-3.  Those of Sultanova et al. (2009) are
# fits of one term, whose Vd falls short of the makers' by up to 4.
POLYMERS = "other/commercial polymers"
PLASTICS = {
    "PMMA": "organic/(C5H8O2)n - poly(methyl methacrylate)/nk/Beadie.yml",
    "POLYCARBONATE": "organic/(C16H14O3)n - polycarbonate/nk/Sultanova.yml",
    "POLYSTYRENE": "organic/(C8H8)n - polystyrene/nk/Sultanova.yml",
    "NAS-21": f"{POLYMERS}/NAS-21/nk/Sultanova.yml",
    "OPTOREZ-1330": f"{POLYMERS}/Optorez1330/nk/Sultanova.yml",
    "ZEONEX-E48R": f"{POLYMERS}/ZeonexE48R/nk/Sultanova.yml",
}
FORMULAS: dict[str, Formula] = {
    "formula 1": sellmeier,
    "formula 2": sellmeier_squared,
    "formula 3": polynomial,
    "formula 5": cauchy,
}
D_LINE = 0.5875618


@dataclass(frozen=True)
class Row:
    """A glass as a table writes it: numbers with the fewest digits that mean the same double."""

    name: str
    formula: Formula
    constant: float
    terms: tuple[tuple[float, float], ...]
    wavelengths: tuple[float, float]
    thermal: tuple[float, ...]
    expansion: float | None
    source: str
    nd: float

    def cells(self) -> list[str]:
        """Return the row under `HEADINGS`."""
        return [
            self.name,
            self.formula.__name__,
            number(self.constant),
            " ".join(f"{number(a)} {number(b)}" for a, b in self.terms),
            " ".join(map(number, self.wavelengths)),
            " ".join(map(number, self.thermal)),
            "" if self.expansion is None else number(round(1e6 * self.expansion, 9)),
            self.source,
        ]

    def wrong(self) -> str:
        """Return what is wrong with the row, or nothing.

        Its indices must be possible, fall with the wavelength in the visible, and give the nd that
        the catalogue prints.
        """
        first, last = self.wavelengths
        steps = [first + (last - first) * i / 16 for i in range(17)]
        indices = [self.formula(w, self.constant, self.terms) for w in steps]
        if not all(isinstance(n, float) and 0.99 < n < 8.0 for n in indices):
            return "indices out of bounds within its range"
        blue, red = (self.formula(w, self.constant, self.terms) for w in (0.4861, 0.6563))
        visible = first <= 0.4861 and last >= 0.6563
        if visible and self.terms and self.name != "VACUUM" and not blue > red:
            return "no normal dispersion"
        if not first <= D_LINE <= last or not 1.01 < self.nd < 3.0:
            return ""
        index = self.formula(D_LINE, self.constant, self.terms)
        # The database rounds nd of some glasses to two or three decimals.
        allowed = 6e-4 if self.source == "rii" else 2e-5
        if isinstance(index, complex) or not abs(index - self.nd) < allowed:
            return f"nd {index} for {self.nd}"
        return ""


def number(value: float) -> str:
    """Return the shortest text of a number."""
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return mantissa.removesuffix(".0") + (f"e{int(exponent)}" if e else "")


def row_of_page(path: Path, name: str, source: str) -> Row | None:
    """Return a page of refractiveindex.info's database; None where it has no formula."""
    page: dict[str, Any] = yaml.load(path.read_text(), Loader=getattr(yaml, "CSafeLoader"))  # noqa: B009
    data = next((part for part in page["DATA"] if part["type"] in FORMULAS), None)
    if data is None:
        return None
    values = [float(word) for word in str(data["coefficients"]).split()]
    pairs = tuple(zip(values[1::2], values[2::2], strict=True))
    first, last = (float(word) for word in str(data["wavelength_range"]).split())
    properties = page.get("PROPERTIES") or {}
    kelvin = float((page.get("CONDITIONS") or {}).get("temperature", 293.0))
    thermal: tuple[float, ...] = ()
    for entry in properties.get("thermal_dispersion", []):
        constants = [float(word) for word in str(entry["coefficients"]).split()]
        if entry["type"] == "formula A" and any(constants[:5]):
            # Whole kelvins stand for whole degrees: 293 for 20 °C.
            thermal = (*constants, round(kelvin - (273.0 if kelvin.is_integer() else 273.15), 6))
    expansions = [
        float(entry["value"])
        for entry in properties.get("thermal_expansion", [])
        if str(entry.get("temperature_range")).split() == ["243", "343"]
    ]
    return Row(
        name,
        FORMULAS[data["type"]],
        values[0],
        tuple((a, b) for a, b in pairs if a != 0.0),
        (first, last),
        thermal,
        expansions[0] if expansions and expansions[0] else None,
        source,
        float(properties.get("nd", 0.0)),
    )


def rows_of_catalogue(path: Path, source: str) -> dict[str, Row]:
    """Return the glasses of an `.agf` file by name in capitals."""
    rows = {}
    for key, entry in parse_agf(decode_text(path.read_bytes(), path.name), path.name).items():
        try:
            glass = read_entry(entry)
        except InputError as error:
            print("left out:", error, file=sys.stderr)
            continue
        thermal = glass.thermal or ()
        rows[key] = Row(
            glass.name.upper() if glass.name.islower() else glass.name,
            *glass.dispersion,
            glass.wavelengths,
            tuple(thermal),
            glass.expansion or None,
            source,
            glass.nd,
        )
    return rows


def main() -> None:
    """Write a table for each maker."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--database", type=Path, required=True)
    parser.add_argument(
        "--catalogue", nargs=3, action="append", default=[], metavar=("MAKER", "SOURCE", "FILE")
    )
    options = parser.parse_args()
    tables: dict[str, dict[str, Row]] = {}
    for maker, folders in FOLDERS.items():
        table = tables.setdefault(maker, {})
        for folder in folders:
            for path in sorted((options.database / folder).glob("*.yml")):
                row = row_of_page(path, path.stem, "rii")
                if row:
                    table.setdefault(path.stem.upper(), row)
    for name, place in PLASTICS.items():
        row = row_of_page(options.database / place, name, "rii")
        assert row is not None
        tables.setdefault("PLASTIC", {})[name] = row
    for name, (maker, place) in MISSPELT.items():
        row = row_of_page(options.database / place, name, "rii")
        assert row is not None
        tables[maker][name] = row
    for maker, source, path in options.catalogue:
        for key, row in rows_of_catalogue(Path(path), source).items():
            tables.setdefault(maker, {}).setdefault(key, row)
    TABLES.mkdir(exist_ok=True)
    for maker, table in tables.items():
        kept = []
        for row in table.values():
            wrong = row.wrong() or ("" if re.fullmatch(r"[!-~]+", row.name) else "no plain name")
            if wrong:
                print(f"left out: {maker}:{row.name} ({row.source}): {wrong}", file=sys.stderr)
            else:
                kept.append(row)
        with (TABLES / f"{maker.lower()}.csv").open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(HEADINGS)
            writer.writerows(row.cells() for row in sorted(kept, key=lambda row: row.name.upper()))
        print(maker, len(kept))


if __name__ == "__main__":
    main()
