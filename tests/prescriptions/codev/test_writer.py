"""CODE V's .seq format: what is written, beyond surfaces in a row."""

import pytest

from dolens import InputError
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.writer import codev_of
from tests.prescriptions.samples import SINGLET
from tests.refused import refused

BACK = {"type": "sphere", "radius": -50.0, "semi_diameter": 10, "material": "air"}
BREAK = {"type": "coordinate_break", "decenter_x": 0.5, "decenter_y": -2.0, "thickness": 3.0}
TURNS = {"tilt_x": 10.0, "tilt_y": -4.0, "tilt_z": 2.5}


def with_break(**row):
    surfaces = SINGLET["surfaces"] | {
        "2": BACK | {"thickness": 7.0},
        "3": BREAK | row,
        "4": {"type": "sphere", "radius": 90.0, "semi_diameter": 12, "material": "mirror"},
    }
    return SINGLET | {"surfaces": surfaces, "sensor": {"distance": -40.0}}


def written_and_read(prescription):
    text = codev_of(prescription)
    return text, read_codev(text, "lens").prescription


@pytest.mark.parametrize(
    "order", [{}, {"order": "tilt_first"}], ids=["moved first", "tilted first"]
)
def test_a_break_is_a_dummy_surface_of_left_handed_turns(order):
    """ADE and BDE are left-handed, CDE is right-handed; REV undoes what its numbers say."""
    text, found = written_and_read(with_break(**TURNS, **order))
    lines = text.splitlines()
    at = lines.index("S     0.0 3.0")
    # Numbers behind REV are those of the move that it undoes.
    reverse = bool(order)
    sign = -1.0 if reverse else 1.0
    expected = {"XDE": 0.5, "YDE": -2.0, "ADE": -10.0, "BDE": 4.0, "CDE": 2.5}
    own = [line.split() for line in lines[at + 1 : at + 6 + reverse]]
    assert [words for words in own if len(words) == 1] == [["REV"]] * reverse
    assert {w[0]: float(w[1]) for w in own if len(w) == 2} == {
        key: sign * value for key, value in expected.items()
    }
    back = found["surfaces"]["3"]
    assert {key: back[key] for key in TURNS} == TURNS
    assert back.get("order") == order.get("order")


def test_a_system_comes_back():
    system = {
        "temperature": 35.0,
        "pressure": 0.5,
        "wavelengths": [486.0, 588.0],
        "reference_wavelength": 588.0,
        "wavelength_weights": [1.0, 3.0],
        "entrance_pupil_diameter": 6.0,
        "object_material": "1.25",
        "fields": {
            "angles": [[0.0, 0.0], [0.0, 5.0]],
            "weights": [2.0, 1.0],
            "vignetting": [{}, {"decenter_y": 0.125, "compression_y": 0.25}],
        },
        "sensor": {"distance": 30.0, "curvature": -0.01, "conic": -1.0},
    }
    text, found = written_and_read(SINGLET | system)
    # The upper edge of the pupil is at 1 - 0.125, the lower one at -(1 - 0.375).
    assert "VUY   0.0 0.125" in text and "VLY   0.0 0.375" in text
    for key, value in system.items():
        if key == "fields":
            assert value["vignetting"][1].items() <= found[key]["vignetting"][1].items()
            assert not any(found[key]["vignetting"][0].values())
            assert (found[key]["angles"], found[key]["weights"]) == (
                value["angles"],
                value["weights"],
            )
        elif key == "sensor":
            assert found[key] == {"distance": 30.0, "radius": -100.0, "conic": -1.0}
        else:
            assert found[key] == value, key


@pytest.mark.parametrize(
    ("surface", "said"),
    [
        ({"type": "b_spline"}, "cannot hold type 'b_spline'"),
        ({"a22": 1e-9}, "cannot hold 'a22' (allowed: a4 to a20)"),
        ({"radius": 0.0}, "'radius' is 0; write .inf for a plane"),
        ({"material": "1.6/35.5/0.01"}, "cannot hold ΔPgF of material"),
        ({"material": "1.6/135.5"}, "has nd from 1 to 2 and Vd below 100"),
        ({"material": "1.51680012/64.17"}, "six decimals of nd and four of Vd at most"),
    ],
)
def test_what_the_format_cannot_hold_is_named(surface, said):
    surfaces = SINGLET["surfaces"] | {"1": SINGLET["surfaces"]["1"] | surface}
    with refused(said, "lens: surface 1"):
        codev_of(SINGLET | {"surfaces": surfaces, "entrance_pupil_diameter": 6.0})


@pytest.mark.parametrize("size", [5e-324, 1e-310, 0.1 + 0.2])
def test_an_entrance_pupil_is_no_smaller_than_that_of_the_stop(size):
    surfaces = SINGLET["surfaces"] | {"1": SINGLET["surfaces"]["1"] | {"semi_diameter": size}}
    _, found = written_and_read(SINGLET | {"surfaces": surfaces})
    assert found["entrance_pupil_diameter"] == pytest.approx(2.0 * size, rel=1e-8)
    assert found["entrance_pupil_diameter"] >= 2.0 * size


def test_a_break_in_radians_is_refused():
    with pytest.raises(InputError, match="'tilt_x_radians': its angles are in degrees"):
        codev_of(with_break(tilt_x_radians=0.1))
