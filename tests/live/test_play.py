"""A lens is changed by hand; what comes of it is the lens of a file with these numbers."""

import base64
import math

import pytest
import torch
import yaml

from dolens import InputError, load_lens
from dolens.live.play import PlayedLens
from dolens.prescriptions import lens_from_prescription, lens_names, prescription_of
from dolens.prescriptions.files import decode_prescription


@pytest.fixture
def played():
    return PlayedLens(load_lens("cooke_triplet"), "cooke_triplet")


def efl(lens):
    return lens.first_order(lens.primary_wavelength).efl.item()


def file_of(played, suffix=".yaml"):
    saved = played.saved(suffix)
    return decode_prescription(base64.b64decode(saved["data"]), saved["name"])


def test_a_radius_makes_the_lens_of_a_file_with_that_radius(root, played):
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    prescription["surfaces"]["1"]["radius"] = 21.5
    wanted = lens_from_prescription(prescription)
    played.change({"surfaces.1.radius": 21.5})
    assert efl(played.seen.lens) == efl(wanted) != efl(load_lens("cooke_triplet"))
    played.change({"surfaces.1.curvature": 0.0})
    assert math.isinf(file_of(played)["surfaces"]["1"]["radius"])


def test_glass_gaps_field_and_temperature_change_what_they_name(played):
    played.change({"surfaces.1.material": "SCHOTT:N-SK16", "thicknesses.2": 6.1, "field": 10.0})
    lens = played.seen.lens
    assert lens.materials[1].name == "SCHOTT:N-SK16" and float(lens.thicknesses["2"]) == 6.1
    assert played.seen.draft.where.fields.tolist() == [[0.0, 0.0], [0.0, 7.0], [0.0, 10.0]]
    assert file_of(played)["fields"]["angles"] == [[0.0, 0.0], [0.0, 7.0], [0.0, 10.0]]
    assert played.values()["field"] == 10.0
    glass = PlayedLens(played.seen.lens, "glass")  # whose catalogue says dn/dT
    before = efl(glass.seen.draft.lens)
    glass.change({"temperature": 60.0})
    assert efl(glass.seen.draft.lens) == efl(glass.seen.lens.at(60.0)) != before
    assert efl(glass.seen.lens) == before


def test_the_aperture_is_the_one_asked_for(played):
    played.change({"f_number": 8.0})
    assert played.values()["f_number"] == pytest.approx(8.0, rel=1e-9)
    played.change({"entrance_pupil": 5.0})
    assert played.values()["entrance_pupil"] == pytest.approx(5.0, rel=1e-9)
    assert played.seen.lens.surfaces["4"].semi_diameter == pytest.approx(3.86 * 5.0 / 10.146, 1e-3)


def test_undo_and_redo_go_through_whole_steps(played):
    first = played.values()
    for curvature in (0.046, 0.047, 0.048):  # a hand that drags
        played.change({"surfaces.1.curvature": curvature}, done=False)
    played.change({"surfaces.1.curvature": 0.049}, done=True)
    played.change({"sensor_distance": 41.0})
    assert played.steps == (2, 0)
    played.undo()
    assert played.values()["sensor_distance"] == first["sensor_distance"]
    assert played.values()["surfaces.1.curvature"] == 0.049
    played.undo()
    assert played.values() == first
    played.undo()
    assert played.values() == first
    played.redo()
    assert played.values()["surfaces.1.curvature"] == 0.049
    played.reset()
    assert played.values() == first and played.steps == (2, 0)


def test_refocusing_makes_the_spots_smallest_and_can_be_kept_up(played):
    played.change({"sensor_distance": 40.0})
    blurred = played.seen.draft.spots[1].square().mean()
    played.refocus()
    assert played.seen.draft.spots[1].square().mean() < 0.01 * blurred
    assert abs(played.seen.draft.focus_shift) < 1e-9
    played.focus = True
    played.change({"surfaces.1.radius": 21.0})
    assert abs(played.seen.draft.focus_shift) < 1e-9


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"surfaces.1.radius": 5.0}, "surface 1.*semi_diameter"),
        ({"surfaces.1.radius": 0.0}, "'radius' is 0"),
        ({"surfaces.9.curvature": 0.1}, "'surfaces.9.curvature' is unknown"),
        ({"thicknesses.1": "thick"}, "thicknesses.1: must be a number, not 'thick'"),
        ({"thicknesses.1": True}, "must be a number"),
        ({"thicknesses.1": float("nan")}, "must be finite"),
        ({"thicknesses.1": float("inf")}, "must be finite"),
        ({"thicknesses.1": 10**400}, "must be finite"),
        ({"thicknesses.1": -1.0}, "the glass behind surface 1 has a negative thickness"),
        ({"thicknesses.5": 0.5}, "the glass behind surface 5 has a negative edge"),
        ({"thicknesses.2": -0.1}, "the air behind surface 2 has a negative thickness"),
        ({"surfaces.1.material": "N-NONE"}, "N-NONE"),
        ({"surfaces.1.material": 1.5}, "must be the name of a glass"),
        ({"f_number": -1.0}, "f_number must be positive"),
        ({"field": 95.0}, "field: 95; allowed"),
        ({"sensor.distance": 1.0}, "is unknown"),
        ({"__class__": 1.0}, "is unknown"),
    ],
)
def test_what_makes_no_lens_is_one_line_and_changes_nothing(played, changes, said):
    before = played.seen
    with pytest.raises(InputError, match=said) as problem:
        played.change(changes)
    assert "\n" not in str(problem.value)
    assert played.seen is before and played.steps == (0, 0)


def test_an_optimization_lowers_the_merit_and_keeps_the_focal_length(played):
    played.change({"sensor_distance": 41.5})
    before = played.seen
    state, said = played.optimized(["sensor_distance", "surfaces.6.curvature"], True)
    assert played.seen is before  # until it is taken
    assert said.startswith("RMS spot radius")
    played.take(state)
    assert played.seen.draft.spots[1].square().mean() < 0.1 * before.draft.spots[1].square().mean()
    assert efl(played.seen.lens) == pytest.approx(efl(before.lens), abs=0.05)
    played.undo()
    assert played.values()["sensor_distance"] == 41.5
    for variables, problem in (([], "tick the values"), (["field"], "'field' is unknown")):
        with pytest.raises(InputError, match=problem):
            played.optimized(variables, True)


@pytest.mark.parametrize("suffix", [".yaml", ".json", ".zmx", ".seq", ".txt"])
def test_a_saved_file_is_the_lens(played, suffix):
    played.change({"surfaces.1.radius": 21.5, "thicknesses.2": 6.1, "f_number": 5.6})
    back = lens_from_prescription(file_of(played, suffix))
    for name, value in played.seen.lens.named_parameters():
        torch.testing.assert_close(dict(back.named_parameters())[name], value, check_dtype=False)


def test_a_lens_that_nobody_touched_is_saved_as_it_was(played):
    assert file_of(played) == decode_prescription(
        yaml.safe_dump(prescription_of(load_lens("cooke_triplet"))).encode(), "lens.yaml"
    )
    with pytest.raises(InputError, match=r"save: '.len' is unknown"):
        played.saved(".len")


@pytest.mark.parametrize("name", lens_names())
def test_every_lens_of_dolens_has_controls_that_move_it(name):
    played = PlayedLens(load_lens(name), name)
    values = played.values()
    assert [control["key"] for control in played.controls] == list(values)
    for control in played.controls:
        if control["kind"] != "glass":
            assert control["low"] <= values[control["key"]] <= control["high"], control["key"]
    played.change({"sensor_distance": values["sensor_distance"] * 1.01})
    assert played.steps == (1, 0)
