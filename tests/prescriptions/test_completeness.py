"""What a lens file holds is used, refused or listed as passed over; no key is read by nobody."""

import json
import re
from pathlib import Path

import pytest

from dolens import load_lens
from dolens.errors import InputError
from dolens.prescriptions.build import prescription_of
from dolens.prescriptions.json_lenses import read_json
from dolens.prescriptions.lens_formats import read_lens
from tests.prescriptions.codev_samples import TRIPLET as CODE_V_TRIPLET
from tests.prescriptions.test_oslo import TRIPLET as OSLO_TRIPLET

PEERS = Path(__file__).parent / "peer_files"
# A longer distance is infinite.
FAR = 1e10
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])")
# Classes of a program's own objects, beside which its values stand.
WRAPPERS = ("__instance_type__", "attributes")


def leaves(content, place=()):
    """Yield the place and value of each number, text and truth value of a JSON file."""
    if isinstance(content, dict | list):
        entries = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in entries:
            yield from leaves(value, (*place, key))
    elif content is not None:
        yield place, content


def other(value):
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}x"
    return 1.01 * value + 0.01 if abs(value) < FAR else -3.0


def fingerprint(content):
    """Return a file's prescription and what is passed over; None where it is refused."""
    try:
        return read_json(json.dumps(content), "lens")
    except InputError:
        return None


def unnoticed(content):
    """Return the places whose change is neither seen in the lens, nor refused, nor listed."""
    before = fingerprint(content)
    assert before is not None
    listed = [entry.strip("'").split(".") for entry in before[1]]
    found = []
    for place, value in leaves(content):
        named = [k for k in place if isinstance(k, str) and k not in WRAPPERS]
        if "__instance_type__" in place or any(named[: len(path)] == path for path in listed):
            continue
        inside = content
        for key in place[:-1]:
            inside = inside[key]
        inside[place[-1]] = other(value)
        if fingerprint(content) == before:
            found.append((place, value))
        inside[place[-1]] = value
    return found


@pytest.mark.parametrize("name", ["optiland_rich.json", "ray_optics_rich.roa"])
def test_each_key_is_used_refused_or_listed(name):
    assert unnoticed(json.loads((PEERS / name).read_text())) == []


# Lines without optical effect: comments, counts, sizes for drawing, and what solves came from.
@pytest.mark.parametrize(
    ("name", "text", "silent"),
    [
        ("a.len", OSLO_TRIPLET, r"//|NXT|LEN NEW|AP   |CBK|DLRS|END|PY|V "),
        ("a.seq", CODE_V_TRIPLET, r"RDM;LEN|  CCY"),
    ],
)
def test_each_number_of_a_text_is_used_refused_or_listed(name, text, silent):
    before, missed, at = read_lens(text.encode(), Path(name)), [], 0
    for line in text.splitlines(keepends=True):
        for found in NUMBER.finditer(line) if not re.match(silent, line) else ():
            whole = found[0].lstrip("-").isdecimal()
            changed = other(int(found[0]) if whole else float(found[0]))
            begin, end = at + found.start(), at + found.end()
            put = f"{text[:begin]}{int(changed) + 1 if whole else changed!r}{text[end:]}"
            try:
                if read_lens(put.encode(), Path(name)) == before:
                    missed.append((line, found[0]))
            except InputError:
                pass
        at += len(line)
    assert missed == []


@pytest.mark.parametrize(
    ("name", "text", "old"),
    [("a.len", OSLO_TRIPLET, "22.014"), ("a.seq", CODE_V_TRIPLET, "22.014")],
)
def test_a_decimal_comma_is_named(name, text, old):
    with pytest.raises(InputError, match="comma"):
        read_lens(text.replace(old, "22,014").encode(), Path(name))


def test_a_mirror_of_optiland_reflects():
    """Optiland 0.6 says so in the interaction of the surface."""
    surfaces = prescription_of(load_lens(PEERS / "optiland_mirror.json"))["surfaces"]
    assert surfaces["2"]["material"] == "mirror"


def test_an_ideal_lens_of_optiland_has_its_focal_length():
    rows = prescription_of(load_lens(PEERS / "optiland_thin_lens.json"))["surfaces"]
    assert rows["2"]["type"] == "paraxial_lens"
    assert rows["2"]["focal_length"] == 50.0


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("phase", "PhaseInteractionModel"),
        ("grating", "DiffractiveInteractionModel"),
        ("grating2", "DiffractiveInteractionModel"),
        ("tilt", "tilted"),
        ("zernike", "shape 'Zernike"),
        ("toroidal", "shape 'Toroidal"),
    ],
)
def test_what_bends_light_otherwise_is_refused(name, says):
    with pytest.raises(InputError, match=says):
        load_lens(PEERS / f"optiland_{name}.json")


@pytest.mark.parametrize("key", ["coating", "bsdf"])
def test_coatings_and_scatter_are_listed(key):
    listed = read_json((PEERS / f"optiland_{key}.json").read_text(), "lens").passed_over
    assert any(key in entry for entry in listed)
