"""Damaged and hostile lens files: each is a lens, or one clear line that can be printed."""

import math
from itertools import pairwise

import pytest

from dolens import InputError, load_lens
from dolens.errors import check_keys
from dolens.optics.glass_catalog import glass_folders
from dolens.prescriptions.files import find_lens
from dolens.prescriptions.plain_values import plain_values
from scripts.fuzz_lens_files import outcome
from tests.prescriptions.codev.samples import TRIPLET as CODE_V
from tests.prescriptions.mutations import mutated
from tests.prescriptions.samples import require_refused
from tests.prescriptions.test_oslo import TRIPLET as OSLO
from tests.prescriptions.zemax.samples import triplet

LENS = """surfaces:
  1: {{type: {kind}, radius: {radius}, semi_diameter: 5, thickness: 4, material: {material}{more}}}
  2: {{radius: -50, semi_diameter: {size}, material: air}}
sensor: {{distance: {distance}}}
"""
GIVEN = {
    "kind": "even_asphere",
    "radius": "50",
    "material": "1.5168/64.17",
    "more": "",
    "size": "5",
    "distance": "95",
}


def lens_with(end="", **given):
    return LENS.format(**GIVEN | given) + end


# YAML has numbers to other bases and dates, which a lens's numbers are not.
@pytest.mark.parametrize(
    "text",
    ["0b", "0b1", "0x1F", "1:60", "1:30", "190:20:30.5", "2001-13-01", "2001-12-14", "yes", "=",
     "x"],
)  # fmt: skip
def test_what_is_no_decimal_number_is_refused_by_its_key(text, tmp_path):
    said = "'sensor.distance' must be a number, not "
    require_refused(tmp_path / "lens.yaml", lens_with(distance=text), said)


@pytest.mark.parametrize(
    ("text", "value"),
    [("1", 1), ("-1.5", -1.5), ("1e-6", 1e-6), ("2.E3", 2e3), (".5", 0.5), (".inf", math.inf),
     ("-.INF", -math.inf), ("0.1", 0.1), ("+7", 7)],
)  # fmt: skip
def test_decimal_numbers_are_numbers(text, value):
    found = plain_values(f"a: {text}", "file")["a"]
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (lens_with(distance="9" * 5000), "a number of 5000 letters"),
        (lens_with(distance="9" * 350), "'sensor.distance' must be a number, not 999"),
        (lens_with(radius="1e-320"), "'radius' is 9.99989e-321, too small for a surface"),
        (lens_with(radius="1e-200"), "too small for a surface"),
        (lens_with(size="1e90"), "semi_diameter 1e+90 mm exceeds the surface"),
        (lens_with(size="1e200"), "semi_diameter must be positive and finite, not 1e+200 mm"),
        (lens_with("object_distance: 0\n"), "'object_distance' must be positive, not 0"),
        (lens_with(more=", a1000000: 1"), "'a1000000': the highest order of a coefficient is 400"),
        (lens_with(more=", a" + "4" * 900 + ": 1"), "the highest order of a coefficient is 400"),
        (
            lens_with(kind="xy_polynomial", radius=".inf", more=", x999y999: 1"),
            "'x999y999': the high",
        ),
        (lens_with(kind="zernike_fringe", more=", z1000000: 1"), "'z1000000': the highest order"),
        (lens_with(kind="q_con", more=", q1000000: 1"), "'q1000000': the highest order"),
        (lens_with(more=", phase: {type: radial, p1000000: 1}"), "'p1000000': the highest order"),
        (lens_with(more=", a４: 1"), "unknown key 'a４'"),
        (lens_with("stop: !!bool x\n"), "'x' is neither true nor false"),
        (lens_with("stop: !!int x\n"), "'x' is no number"),
        (lens_with("stop: !!timestamp x\n"), "could not determine a constructor"),
        (lens_with("stop: !!set {a}\n"), "could not determine a constructor"),
        (lens_with("name: !!python/name:os.system\n"), "could not determine a constructor"),
        (lens_with("a: &a [*a]\n"), "it means more than 2000000 values"),
        (lens_with("\x1b[31m: 1\n"), "control characters are not allowed"),
        (lens_with('"\\e[31m": 1\n'), "unknown key '\\x1b[31m'"),
        (lens_with('"a\\nb": 1\n'), "unknown key 'a b'"),
        ("surfaces: {" + "1: {}, " * 2 + "}", "key '1' is given twice"),
        ("a: " + "[" * 500, "it is nested too deeply"),
    ],
)
def test_a_hostile_prescription_ends_in_one_line(content, said, tmp_path):
    require_refused(tmp_path / "lens.yaml", content, said)


def test_aliases_that_multiply_are_refused(tmp_path):
    names = "abcdefghi"
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise(names)
    )
    require_refused(tmp_path / "lens.yaml", lens_with(bomb), "it means more than 2000000 values")


def test_a_lens_of_a_million_surfaces_is_refused(tmp_path):
    rows = ", ".join(f'"{n}": 0' for n in range(10_001))
    content = f'{{"surfaces": {{{rows}}}, "sensor": {{"distance": 1}}}}'
    require_refused(tmp_path / "lens.json", content, "has 10001 surfaces; a lens has 10000 at most")


@pytest.mark.parametrize("wavelength", [0.0, -550.0, math.nan])
@pytest.mark.parametrize("material", ["1.5168/64.17", "1.5168/64.17/0.01", "1.5", "N-BK7"])
def test_a_wavelength_is_positive(wavelength, material, tmp_path):
    path = tmp_path / "lens.yaml"
    path.write_text(lens_with(material=material))
    with pytest.raises(InputError, match=r"wavelength (0|-550|nan) nm"):
        load_lens(path).first_order(wavelength)


def test_a_formula_without_an_index_is_refused(tmp_path):
    catalogue = tmp_path / "own.agf"
    catalogue.write_text("NM NONE 2 0 1.5 60\nCD -9 0.01 0 0 0 0\nLD 0.3 2.0\n")
    path = tmp_path / "lens.yaml"
    path.write_text(lens_with(material="OWN:NONE"))
    with glass_folders(catalogue), pytest.raises(InputError, match="gives no index at 550 nm"):
        load_lens(path).first_order(550.0)


def test_a_message_can_be_printed_and_has_an_end():
    error = InputError(f"file: '{'9' * 5000}\x1b[2J\n\u202e' (allowed: a number)")
    assert str(error).startswith("file: '999")
    assert str(error).endswith("\\x1b[2J \\u202e' (allowed: a number)")
    assert len(str(error)) == 500
    assert str(error).isprintable()
    # What is said about another message is no longer.
    assert len(str(InputError(f"run: {error}"))) == 500
    assert str(InputError(error)) == str(error)
    with pytest.raises(InputError, match="unknown key 'kkk"):
        check_keys(["k" * 10**6], [f"key{n}" for n in range(100)], "file")


SAMPLES = {
    ".yaml": lambda: find_lens("cooke_triplet").read_bytes(),
    ".zmx": lambda: triplet().encode(),
    ".seq": lambda: CODE_V.encode(),
    ".len": lambda: OSLO.encode(),
}


@pytest.mark.parametrize("suffix", SAMPLES)
def test_mutated_files(suffix, tmp_path):
    path = tmp_path / f"lens{suffix}"
    for seed in range(6):
        path.write_bytes(mutated(SAMPLES[suffix](), suffix, seed))
        assert outcome(path)[0] in ("lens", "one line"), (seed, outcome(path))
