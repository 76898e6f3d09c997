"""What a glass catalogue says changes what is computed of its glasses, or a glass is refused."""

import json
import re
from functools import cache

import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.optics.agf import AgfEntry, parse_agf, read_entry
from dolens.optics.glass import Environment
from dolens.optics.glass_catalog import user_glass
from tests.optics.test_agf import CATALOGUE
from tests.prescriptions.judged_keys import changed_text, text_with_commas

# Lines without effect, with the number of the word behind #.
NAMED = (
    # Remarks, the code of a glass, and nd and Vd as they are printed: the formula gives the index.
    r"(CC|GC) .*",
    r"NM .* #[345]",
    # No price.
    r"OD - .* #1",
    # Switches of a program's own substitution of glass, and how often a glass is melted.
    r"NM .* #[68]",
    # Expansion between 100 and 300 °C, ΔPgF as printed, and a switch of dn/dT.
    r"ED .* #[245]",
)
# nm, a third of a per cent apart, so that the ends of a range are seen.
WAVELENGTHS = torch.logspace(2.2, 3.8, 1100, dtype=torch.float64)


@cache
def numbers(name, lines):
    """Everything that is computed of a glass with these lines; None where it is refused."""
    entry = AgfEntry(name, name, json.loads(lines))
    try:
        printed = read_entry(entry)
    except InputError:
        return None
    glass = user_glass("LENS", entry)
    inside = WAVELENGTHS[WAVELENGTHS.clamp(*glass.wavelengths) == WAVELENGTHS]
    found = [[glass.absorption(wave) for wave in (303.0, 310.0, 350.0, 399.0, 403.0)]]
    for there in (glass, glass.at(Environment(75.0, 0.9))):
        found.append((there.name, len(inside), there.index(inside).tolist(), there.expansion))
    return [*found, printed.status, printed.price, printed.density, printed.resistances]


def all_numbers(text):
    """The numbers of every glass of a catalogue."""
    return [
        numbers(one.name, json.dumps(one.lines)) for one in parse_agf(text, "lens.agf").values()
    ]


def test_each_number_of_a_catalogue():
    before = repr(all_numbers(CATALOGUE))
    missed = [
        place
        for place, changed in changed_text(CATALOGUE)
        if not any(re.fullmatch(pattern, f"{place[0]} #{place[1]}") for pattern in NAMED)
        and repr(all_numbers(changed)) == before
    ]
    assert missed == []


def test_a_decimal_comma_in_a_catalogue_is_named():
    lines = 0
    for place, changed in text_with_commas(CATALOGUE):
        if not place[0].startswith(("CC", "GC")):
            said = []
            for entry in parse_agf(changed, "lens.agf").values():
                try:
                    read_entry(entry)
                except InputError as error:
                    said.append(str(error))
            assert any("decimal comma" in message for message in said), place
            lines += 1
    assert lines > 50


def test_a_coefficient_that_the_formula_does_not_have_is_refused():
    entry = parse_agf("NM A 5 0 1.5 60\nCD 1.5 0.01 0.001 0.2\nLD 0.4 0.7\n", "lens.agf")["A"]
    with pytest.raises(InputError, match="dispersion formula 5 has 3 coefficients"):
        read_entry(entry)


def test_a_decimal_comma_in_columns_is_named(tmp_path):
    """Of dO's text: every number of a row."""
    rows = "O 0.0 0.0 10.0 air\nS 0.0 20.5 10.0 1.5/60.0 0.5 1.0e-6\nI 30.5 0.0 5.0 air\n"
    text = f"lens\ntype distance roc diameter material\n{rows}"
    path = tmp_path / "lens.txt"
    path.write_text(text)
    load_lens(path)
    for row in rows.splitlines()[1:]:
        for word in row.split()[1:]:
            if "." in word:
                path.write_text(text.replace(row, row.replace(word, word.replace(".", ","), 1)))
                with pytest.raises(InputError, match="decimal comma"):
                    load_lens(path)
