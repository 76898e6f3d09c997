"""Configurations of Zemax's files are the states of a lens."""

import re

import pytest
import torch

from dolens import InputError, load_lens, save_lens
from dolens.prescriptions import lens_from_prescription
from dolens.prescriptions.zemax.reader import read_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.samples import SINGLET
from tests.prescriptions.test_states import SPECTRUM, same, with_states
from tests.prescriptions.zemax.samples import triplet

ZOOM = "published/zoom_us7106520_ex8"


def test_a_zemax_file_holds_the_states_as_configurations(tmp_path):
    lens = load_lens(ZOOM)
    save_lens(lens, tmp_path / "zoom.zmx")
    again = load_lens(tmp_path / "zoom.zmx")
    for state in lens.state_names:
        a, b = lens.in_state(state), again.in_state(state)
        pairs = zip(a.parameters(), b.parameters(), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
        assert (a.fields, a.object_distance) == (b.fields, b.object_distance)
        number = str(a.stop)
        assert a.surfaces[number].aperture == b.surfaces[number].aperture


def test_a_lens_that_is_none_of_its_states_stays_the_lens_itself(tmp_path):
    lens = lens_from_prescription(with_states(longer={"surfaces": {"1": {"thickness": 6.0}}}))
    save_lens(lens, tmp_path / "lens.zmx")
    again = load_lens(tmp_path / "lens.zmx")
    assert again.state_names == ("longer",)
    gaps = [float(one.thicknesses["1"]) for one in (again, again.in_state("longer"))]
    assert gaps == [5.0, 6.0]


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({"temperature": 40.0}, "state 'a': a .zmx file cannot hold 'temperature' of a state"),
        (
            {"wavelengths": [500.0, 600.0]},
            "state 'a': a .zmx file has as many fields and wavelengths",
        ),
        (
            {"object_distance": 100.0, "fields": {"heights": [[0, 0]]}},
            "state 'a': a .zmx file has fields of one kind in all its states",
        ),
    ],
)
def test_what_no_configuration_holds_is_refused(state, said, tmp_path):
    lens = lens_from_prescription(with_states(a=state))
    with pytest.raises(InputError, match=said):
        save_lens(lens, tmp_path / "lens.zmx")


@pytest.mark.parametrize("pupil", [{"entrance_pupil_diameter": 4.0}, {"f_number": None}])
def test_a_configuration_has_the_pupil_of_the_others(pupil):
    """Of its own it may have another number, and no other kind of aperture."""
    lens = SINGLET | {"f_number": 5.0, "states": {"a": pupil}}
    with pytest.raises(InputError, match="state 'a': no configuration"):
        zemax_of(lens)


def test_configurations_of_a_file_are_its_states():
    more = (
        "MNUM 2 2\nMOFF 0 1\n"
        "THIC 2 1 7.5 0 0 0 1 1 1 0 0\nTHIC 2 2 6.008 0 0 0 1 1 1 0 0\n"
        "CRVT 3 1 -0.05 0 0 0 1 1 1 0 0\nCRVT 3 2 -0.045018683 0 0 0 1 1 1 0 0\n"
        "YFIE 3 1 18 0 0 0 1 1 1 0 0\nYFIE 3 2 20 0 0 0 1 1 1 0 0\n"
        'LTTL 0 1 "close" 0 0 0 1 1 0 0.0 ""\n'
    )
    found = read_zemax(triplet() + more)
    plain = read_zemax(triplet()).prescription
    assert {k: v for k, v in found.prescription.items() if k != "states"} == plain
    close = found.prescription["states"]["close"]
    assert close["surfaces"]["2"]["thickness"] == 7.5
    assert close["surfaces"]["3"] == {"radius": -20.0}
    assert close["fields"]["angles"][2] == [0.0, 18.0]
    assert list(found.prescription["states"]) == ["close", "c2"]
    assert not any("configuration" in said for said in found.passed_over)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("THIC 2 1 6.008\nTHIC 2 2 7\nGLSS 1 1 BK7\nGLSS 1 2 SF6\n", "GLSS 1 is not held"),
        ("STPS 0 1 3\nSTPS 0 2 4\n", "STPS 0 is not held"),
        ("PRAM 2 1 1.0 0 0\nPRAM 2 2 2.0 0 0\n", "does not say which parameter it is"),
        ("APER 0 1 5\nAPER 0 2 6\n", "APER sets an aperture that the file does not have"),
    ],
)
def test_a_configuration_that_cannot_be_held_is_passed_over_and_listed(lines, said):
    found = read_zemax(triplet() + "MNUM 2 1\n" + lines)
    assert "states" not in found.prescription
    assert found.passed_over[-1].startswith("the other 1 of 2 configurations, which set")
    assert said in found.passed_over[-1]


def test_the_spectrum_of_a_configuration_is_its_own(tmp_path):
    """Weights that are the lens's stay so where the wavelengths move, and so does the reference."""
    more = "MNUM 2 1\nWAVE 1 1 0.486\nWAVE 1 2 0.45\nWLWT 3 1 1\nWLWT 3 2 0\n"
    text = triplet()
    for n, (wave, weight) in enumerate(((0.486, 1), (0.588, 2), (0.656, 1)), 1):
        text = re.sub(rf"(?m)^WAVM {n} .*$", f"WAVM {n} {wave} {weight}", text)
    text = re.sub(r"(?m)^PWAV .*$", "PWAV 2", text)
    (tmp_path / "lens.zmx").write_text(text + more)
    lens = load_lens(tmp_path / "lens.zmx")
    save_lens(lens, tmp_path / "again.zmx")
    save_lens(lens, tmp_path / "again.yaml")
    for one in (lens, load_lens(tmp_path / "again.zmx"), load_lens(tmp_path / "again.yaml")):
        same(one, lens)
        found = [[getattr(one.in_state(s), what) for what in SPECTRUM] for s in ("c1", "c2")]
        assert found[0] == [(486.0, 588.0, 656.0), (1.0, 2.0, 1.0), 588.0]
        assert found[1] == [(450.0, 588.0, 656.0), (1.0, 2.0, 0.0), 588.0]


def test_a_solve_is_not_repeated_in_other_configurations():
    """What a solve gave holds for the configuration that the file was saved in."""
    text = triplet().replace("SURF 6\n", "SURF 6\n  MAZH 0 0\n")
    found = read_zemax(text + "MNUM 2 1\nTHIC 2 1 6.008\nTHIC 2 2 7.0\n")
    assert "states" not in found.prescription
    assert "a solve holds for the current one (MAZH" in found.passed_over[-1]
