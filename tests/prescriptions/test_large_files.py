"""Lens files that are large, or ask for much: each is a lens or one line, in time that their size
explains.
"""

import pytest

from dolens import InputError
from dolens.optics.glass_catalog import user_entries
from dolens.optics.surfaces.outlines import Polygons
from dolens.prescriptions.files import read_lens_file
from scripts.fuzz_lens_files import outcome
from tests.prescriptions.large_files import GREEDY, LARGE, YAML, ZEMAX, configurations
from tests.prescriptions.samples import require_refused

# Bytes: what took time with the square of its size took minutes with so many.
SIZE = 150_000


@pytest.mark.parametrize("kind", LARGE)
def test_a_large_file_is_a_lens_or_one_line(kind, tmp_path):
    suffix, make = LARGE[kind]
    path = tmp_path / f"own{suffix}"
    path.write_text(make(SIZE))
    try:
        user_entries(path) if suffix == ".agf" else read_lens_file(path)
    except InputError as error:
        assert str(error).startswith(f"{path}: ")
        assert str(error).isprintable()


@pytest.mark.parametrize("kind", GREEDY)
def test_a_small_file_that_names_a_large_number_is_a_lens_or_one_line(kind, tmp_path):
    suffix, text = GREEDY[kind]
    path = tmp_path / f"own{suffix}"
    path.write_text(text)
    said = outcome(path)
    assert said[0] in ("lens", "one line"), said


SURFACES = "".join(f"SURF {n}\n  CURV 0.01\n  DISZ 1\n" for n in range(30_000))
LIMITS = {
    "30 000 surfaces of Zemax": (".zmx", SURFACES, "line 30004: more than 10000 surfaces"),
    "states": (
        ".yaml",
        f"{YAML}states: {{{', '.join(f's{n}: ' for n in range(101))}}}",
        "has 101 states; a lens of 2 surfaces has 100 at most",
    ),
    "a grid of one row": (
        ".yaml",
        YAML.replace(
            "type: sphere",
            f"type: grid_sag, spacing_x: 1, spacing_y: 1, sag: [{[0] * 2001}, {[0] * 2001}]",
            1,
        ),
        "'sag' has 2 rows of 2001 numbers (allowed: 2000 each)",
    ),
    "obscurations": (
        ".yaml",
        YAML.replace(
            "}", f", obscuration: [{', '.join(['{semi_diameter: 1}'] * 1001)}]}}", 1
        ),
        "has 1001 parts (allowed: 1000 at most)",
    ),
    "lists in lists": (
        ".json",
        '{"surfaces": {"1": ' + "[" * 200 + "]" * 200 + "}}",
        "it is nested too deeply",
    ),
    "half of a surrogate pair": (".json", '{"name": "\\ud800", "surfaces": {}}', "surrogates not"),
    "a key beyond all surfaces": (".yaml", f"{YAML}{2**61}: 1\n", "is too large a number"),
}  # fmt: skip


@pytest.mark.parametrize("kind", LIMITS)
def test_a_limit_is_said(kind, tmp_path):
    suffix, text, said = LIMITS[kind]
    require_refused(tmp_path / f"own{suffix}", text, said)


def test_an_outline_has_ten_thousand_corners_at_most():
    with pytest.raises(InputError, match="'polygons' have 10001 vertices together"):
        Polygons((tuple((float(n), 0.0) for n in range(10_001)),))


def test_more_configurations_than_a_lens_has_states_are_passed_over(tmp_path):
    path = tmp_path / "own.zmx"
    path.write_text(ZEMAX.replace("MNUM 1 1", "MNUM 1000000000 1\nTHIC 2 1 6\nTHIC 2 2 7"))
    read = read_lens_file(path)
    assert "states" not in read.prescription
    assert read.passed_over[-1] == (
        "the other 1e+09 of 1e+09 configurations, which set THIC 2 (read: the current one, 1): "
        "a lens of this size has 100 states at most"
    )


def test_a_hundred_configurations_are_a_hundred_states(tmp_path):
    path = tmp_path / "own.zmx"
    text = configurations(30 * 60)
    path.write_text(text)
    states = read_lens_file(path).prescription["states"]
    assert len(states) == text.count("THIC")
    assert states["c7"]["surfaces"]["2"] == {"thickness": 8.0}
