"""What a lens file holds is used, refused or listed as passed over; no key is read by nobody."""

import json
from pathlib import Path

import pytest

from dolens import load_lens
from dolens.errors import InputError
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.json_lenses import read_json

PEERS = Path(__file__).parent / "peer_files"
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
    return f"{value}x" if isinstance(value, str) else 1.01 * value + 0.01


def fingerprint(content):
    """Return the lens that a file means and what is passed over; None where it is refused."""
    try:
        prescription, listed = read_json(json.dumps(content), "lens")
        return prescription_of(lens_from_prescription(prescription)), listed
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
