"""States in prescriptions: read, written, and refused in one line."""

import pytest

from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.prescriptions.samples import SINGLET, require_same_parameters
from tests.refused import refused

SPECTRUM = ("wavelengths", "wavelength_weights", "reference_wavelength")


def with_states(**states):
    return SINGLET | {"states": states}


def same(one, other):
    assert one.state_names == other.state_names
    require_same_parameters(one, other)
    for name in one.state_names:
        a, b = one.in_state(name), other.in_state(name)
        for what in ("fields", "object_distance", *SPECTRUM):
            assert getattr(a, what) == getattr(b, what), what
        assert [s.aperture for s in a.surfaces.values()] == [
            s.aperture for s in b.surfaces.values()
        ]


def test_a_prescription_comes_back_to_the_last_bit():
    lens = lens_from_prescription(
        with_states(
            half={"surfaces": {"1": {"radius": 21.7, "a4": 2e-6}}, "sensor": {"distance": 29.1}},
            near={"object_distance": 400.0, "fields": {"heights": [[0, 0], [0, 5]]}, "f_number": 4},
            hot={"temperature": 40.0, "pressure": 0.9},
            blue={"wavelengths": [450.0, 486.0], "wavelength_weights": [1, 2]},
        )
    )
    again = lens_from_prescription(prescription_of(lens))
    same(lens, again)
    assert prescription_of(again) == prescription_of(lens)
    assert again.in_state("blue").primary_wavelength == 450.0
    assert again.in_state("hot").pressure == 0.9


def test_the_f_number_holds_in_a_state_unless_its_stop_is_the_lens_s():
    stop = SINGLET["surfaces"]["1"] | {"semi_diameter": "auto"}
    singlet = SINGLET | {"f_number": 5.0, "surfaces": SINGLET["surfaces"] | {"1": stop}}
    changed = {"surfaces": {"1": {"radius": 30.0}}}
    lens = lens_from_prescription(
        singlet | {"states": {"again": changed, "same_stop": changed | {"f_number": None}}}
    )
    again, same_stop = lens.in_state("again"), lens.in_state("same_stop")
    assert float(again.first_order().f_number) == pytest.approx(5.0, rel=1e-12)
    sizes = [one.surfaces["1"].semi_diameter for one in (lens, same_stop, again)]
    assert sizes[0] == sizes[1] < sizes[2]


def test_an_automatic_semi_diameter_is_the_largest_that_any_state_needs():
    """Light of ±10 degrees meets the second surface where a wider field alone would."""
    back = SINGLET["surfaces"]["2"] | {"semi_diameter": "auto"}
    narrow, wide = {"angles": [[0, 0], [0, 1]]}, {"angles": [[0, 0], [0, 10]]}
    surfaces = SINGLET["surfaces"] | {"2": back}
    singlet = SINGLET | {"surfaces": surfaces, "fields": narrow}
    lens = lens_from_prescription(singlet | {"states": {"wide": {"fields": wide}}})
    alone = lens_from_prescription(singlet | {"fields": wide}).surfaces["2"].semi_diameter
    assert alone > lens_from_prescription(singlet).surfaces["2"].semi_diameter
    for there in (lens, lens.in_state("wide")):
        assert there.surfaces["2"].semi_diameter == alone


@pytest.mark.parametrize(
    ("states", "said"),
    [
        ([1], "states: expected a mapping"),
        ({"a.b": {}}, "state 'a.b': its name has letters"),
        ({"a": {"stop": 2}}, "state 'a': unknown key 'stop'"),
        ({"a": {"surfaces": {"1": {"type": "plane"}}}}, "a state cannot change 'type'"),
        ({"a": {"surfaces": {"1": {"material": "air"}}}}, "a state cannot change 'material'"),
        ({"a": {"surfaces": {"1": {"a6": 1.0}}}}, "a state cannot change 'a6'"),
        ({"a": {"surfaces": {"9": {"radius": 1.0}}}}, "state 'a': surface 9 is not in the lens"),
        ({"a": {"surfaces": {"1": {"radius": 0}}}}, "state 'a': surface 1: 'radius' is 0"),
        ({"a": {"sensor": {"diameter": 3}}}, "state 'a': sensor: unknown key 'diameter'"),
        ({"a": {"temperature": -300}}, "state 'a': temperature -300"),
        ({"a": {"surfaces": {"2": {"thickness": 3}}}}, "the last surface has no 'thickness'"),
    ],
)
def test_a_mistake_takes_one_line(states, said):
    with refused(said, "lens: "):
        lens_from_prescription(SINGLET | {"states": states})


def test_a_state_may_say_what_its_lens_s_wavelengths_weigh():
    """Other wavelengths bring their own weights with them, and a reference."""
    given = dict(zip(SPECTRUM, ([486.1, 587.6, 656.3], [1.0, 2.0, 1.0], 587.6), strict=True))
    states = {
        "middle": {"wavelength_weights": [0, 1, 0]},
        "alike": {"wavelength_weights": None},
        "red": {"reference_wavelength": 656.3},
        "other": {"wavelengths": [500.0, 600.0, 700.0]},
        "same": given | {"wavelengths": [500.0, 587.6, 700.0]},
    }
    lens = lens_from_prescription(SINGLET | given | {"states": states})
    waves, weights, reference = (tuple(given["wavelengths"]), (1.0, 2.0, 1.0), 587.6)
    wanted = {
        "middle": (waves, (0.0, 1.0, 0.0), reference),
        "alike": (waves, None, reference),
        "red": (waves, weights, 656.3),
        "other": ((500.0, 600.0, 700.0), None, 500.0),
        "same": ((500.0, 587.6, 700.0), weights, reference),
    }
    for one in (lens, lens_from_prescription(prescription_of(lens))):
        for name in states:
            there = one.in_state(name)
            assert tuple(getattr(there, what) for what in SPECTRUM) == wanted[name], name
        same(one, lens)
