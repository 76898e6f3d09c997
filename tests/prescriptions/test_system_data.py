"""What a lens is used with: wavelengths, fields, object distance, and the pupil."""

import copy

import pytest
import torch

from dolens import InputError
from dolens.analysis.conditions import conditions
from dolens.experiments.design.states import set_entrance_pupils
from dolens.lens_page.tables import first_order_table
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.refused import refused

SINGLET = {
    "stop": 2,
    "surfaces": {
        "1": {"type": "sphere", "radius": 50.0, "semi_diameter": 12.0, "thickness": 4.0,
              "material": "1.5168/64.17"},
        "2": {"type": "sphere", "radius": -60.0, "semi_diameter": 11.0, "material": "air"},
    },
    "sensor": {"distance": 50.0},
}  # fmt: skip


def used_with(**keys):
    return {**copy.deepcopy(SINGLET), **keys}


def test_a_lens_without_conditions_has_none():
    lens = lens_from_prescription(SINGLET)
    assert lens.wavelengths is lens.reference_wavelength is lens.fields is None
    assert lens.object_distance is None
    assert not {"wavelengths", "fields", "object_distance"} & prescription_of(lens).keys()


@pytest.mark.parametrize("kind", ["angles", "heights"])
def test_conditions_are_kept_and_written(kind):
    said = {
        "wavelengths": [656.2725, 587.5618, 486.1327],
        "reference_wavelength": 587.5618,
        "fields": {kind: [[0.0, 0.0], [-1.5, 20.0]]},
        "object_distance": 650.0,
    }
    lens = lens_from_prescription(used_with(**said))
    assert lens.wavelengths == (656.2725, 587.5618, 486.1327)
    assert lens.reference_wavelength == 587.5618
    assert lens.fields.kind == kind
    assert lens.fields.points == ((0.0, 0.0), (-1.5, 20.0))
    assert lens.object_distance == 650.0
    assert said.items() <= prescription_of(lens).items()


def test_the_first_wavelength_is_the_reference_unless_one_is_named():
    assert lens_from_prescription(used_with(wavelengths=[500, 600])).reference_wavelength == 500.0


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("wavelength", [450.0, 650.0])
def test_a_pupil_closes_the_stop(dtype, wavelength):
    """Seen through a surface of power φ, a stop at t/n behind it is magnified by 1/(1 - tφ/n)."""
    lens = lens_from_prescription(
        used_with(entrance_pupil_diameter=10.0, wavelengths=[wavelength]), dtype
    )
    n = lens.materials[1].index(wavelength)
    shrunk = 1.0 - (4.0 / n) * (n - 1.0) / 50.0
    stop = lens.surfaces["2"].semi_diameter
    assert stop == pytest.approx(5.0 * shrunk, rel=1e-12 if dtype == torch.float64 else 1e-7)
    found = lens.first_order(wavelength).entrance_pupil.diameter
    assert float(found.detach()) == pytest.approx(10.0, rel=1e-6)


def test_an_f_number_closes_the_stop():
    lens = lens_from_prescription(used_with(f_number=4.0))
    assert float(lens.first_order().f_number.detach()) == pytest.approx(4.0, rel=1e-12)


def test_a_pupil_never_opens_the_stop():
    lens = lens_from_prescription(used_with(entrance_pupil_diameter=40.0))
    assert lens.surfaces["2"].semi_diameter == 11.0


def test_a_stop_that_is_clipped_says_so_once():
    """Beside the numbers of the pupil that there is; a rim beyond the pupil takes nothing."""
    fast, slow = {"entrance_pupil_diameter": 40.0}, {"entrance_pupil_diameter": 3.0}
    lens = lens_from_prescription(used_with(**slow, states={"fast": fast}))
    wider = used_with(**slow)
    wider["surfaces"]["2"] |= {"semi_diameter": 12.0}
    assert lens.summary() == lens_from_prescription(wider).summary()
    for one in (lens, lens_from_prescription(prescription_of(lens))):
        found = one.summary(), one.in_state("fast").summary()
        assert [round(each.entrance_pupil_diameter, 9) for each in found[:1]] == [3.0]
        assert found[1].entrance_pupil_diameter < 40.0
    counts = [repr(each).count("asks for a stop of semi-diameter") for each in found]
    # What is written is the size that there is, and asks for no more.
    assert counts == [0, 0]
    clipped = lens.in_state("fast")
    assert "the clear aperture of surface 2 has 11 mm" in clipped.stop_note
    assert repr(clipped.summary()).count(clipped.stop_note) == 1
    assert first_order_table(clipped, conditions(clipped)).caption.count(clipped.stop_note) == 1
    set_entrance_pupils(lens, {None: 2.0, "fast": 20.0})
    assert lens.in_state("fast").stop_note == ""


def test_a_pupil_is_enough_to_size_the_stop():
    data = used_with(f_number=5.0)
    del data["surfaces"]["2"]["semi_diameter"]
    assert float(lens_from_prescription(data).first_order().f_number.detach()) == pytest.approx(
        5.0, rel=1e-12
    )
    data["stop"] = 1
    with pytest.raises(InputError, match="surface 2: 'semi_diameter' is missing"):
        lens_from_prescription(data)


BAD = {
    "not a list": ({"wavelengths": 550}, "'wavelengths' must be a list of wavelengths in nm"),
    "no wavelength": ({"wavelengths": []}, "'wavelengths' must be a list"),
    "negative wavelength": ({"wavelengths": [-5]}, "'wavelengths' must be positive, not -5"),
    "another reference": (
        {"wavelengths": [500], "reference_wavelength": 600},
        "'reference_wavelength' 600.0 is none of 'wavelengths' (allowed: 500.0)",
    ),
    "reference alone": ({"reference_wavelength": 600}, "(allowed: none, as none is given)"),
    "misspelt fields": (
        {"fields": {"angle": [[0, 0]]}},
        "fields: unknown key 'angle'; did you mean 'angles'?",
    ),
    "both fields": (
        {"fields": {"angles": [[0, 0]], "heights": [[0, 0]]}},
        "fields: give one of 'angles', 'pupil_angles' (degrees), 'heights'",
    ),
    "fields as a list": ({"fields": [0, 10]}, "fields: expected a mapping"),
    "a field of one number": (
        {"fields": {"angles": [0, 10]}},
        "fields: 'angles' must be a list of points [x, y], not 0",
    ),
    "a field beside the lens": (
        {"fields": {"angles": [[5, 90]]}},
        "fields: 'angles' must be below 90 degrees (180 along x or y alone), not [5, 90]",
    ),
    "heights at infinity": (
        {"fields": {"heights": [[0, 1]]}},
        "'fields.heights' need an 'object_distance' (mm)",
    ),
    "endless distance": (
        {"object_distance": float("inf")},
        "'object_distance' must be a finite number",
    ),
    "two pupils": (
        {"f_number": 2, "entrance_pupil_diameter": 3},
        "give 'entrance_pupil_diameter' or 'f_number', not both",
    ),
    "negative pupil": ({"f_number": -2}, "'f_number' must be positive, not -2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_conditions(case):
    keys, said = BAD[case]
    with refused(said, "x.yaml: "):
        lens_from_prescription(used_with(**keys), where="x.yaml")


def test_a_pupil_that_its_stop_cannot_reach():
    data = used_with(entrance_pupil_diameter=500.0)
    del data["surfaces"]["2"]["semi_diameter"]
    with pytest.raises(InputError, match="surface 2: closed to 'entrance_pupil_diameter'"):
        lens_from_prescription(data)
