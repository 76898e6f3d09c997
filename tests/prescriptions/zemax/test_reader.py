"""Zemax's .zmx format: what its files mean, and what of them bends no ray."""

import codecs

import pytest

from dolens import load_lens
from dolens.prescriptions.zemax.reader import prescription_from_zemax, read_zemax
from tests.prescriptions.zemax.samples import GLASS, lens_of, singlet, surface, triplet

ENCODED = {
    "UTF-16 LE": lambda text: codecs.BOM_UTF16_LE + text.encode("utf-16-le"),
    "UTF-16 BE": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "UTF-16 LE without mark": lambda text: text.encode("utf-16-le"),
    "UTF-8": lambda text: text.encode("utf-8"),
    "UTF-8 with mark": lambda text: text.encode("utf-8-sig"),
    "Latin-1": lambda text: text.encode("latin-1"),
}


@pytest.mark.parametrize("encoding", ENCODED)
@pytest.mark.parametrize("end", ["\r\n", "\n"], ids=["CRLF", "LF"])
def test_encodings(encoding, end, tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_bytes(ENCODED[encoding](triplet().replace("\n", end)))
    lens = load_lens(path)
    assert lens.name == "Cooke triplet for 35 µm"
    assert len(lens.surfaces) == 6


def test_what_a_file_says_of_its_system():
    found = prescription_from_zemax(triplet())
    assert found["source"] == "Supplement, Section III C"
    assert found["index_model"] == "dfc"
    assert "object_distance" not in found
    assert found["surfaces"]["3"] == {
        "type": "sphere", "radius": -22.213, "material": "1.62/36.37", "semi_diameter": 4.0,
        "thickness": 1.0,
    }  # fmt: skip


def test_wavelengths_are_the_nearest_doubles_in_nm():
    text = singlet("CURV 0.02", "DIAM 5", head="WAVL 0.4861327 0.5875618 0.6562725\nPWAV 3\n")
    found = prescription_from_zemax(text)
    assert found["wavelengths"] == [486.1327, 587.5618, 656.2725]
    assert found["reference_wavelength"] == 656.2725


def test_a_stop_in_air_is_an_aperture():
    found = prescription_from_zemax(singlet("CURV 0.0", "DISZ 4", "DIAM 3"))
    assert found["surfaces"]["1"] == {
        "type": "aperture", "material": "air", "semi_diameter": 3.0, "thickness": 4.0,
    }  # fmt: skip


def test_an_aperture_comes_before_the_diameter_that_is_drawn():
    found = prescription_from_zemax(singlet("CURV 0.1", "DIAM 5", "CLAP 0 4.5 0"))
    assert found["surfaces"]["1"]["semi_diameter"] == 4.5


@pytest.mark.parametrize("diam", ["", "DIAM 9 0"])
def test_an_idle_plane_before_the_image_is_part_of_the_gap(diam):
    text = singlet("CURV 0.02", "DISZ 4", GLASS, "DIAM 5").replace("SURF 3", "SURF 4")
    idle = surface(3, "CURV 0.0", "DISZ 2.5", diam)
    found = prescription_from_zemax(text.replace("SURF 4", idle + "SURF 4"))
    assert list(found["surfaces"]) == ["1", "2"]
    assert found["sensor"]["distance"] == 42.5


@pytest.mark.parametrize("line", ["CLAP 0 3 0", "GLAS ___BLANK 1 0 1.5168 64.17"])
def test_a_plane_before_the_image_that_clips_or_refracts_is_a_surface(line):
    text = singlet("CURV 0.02", "DISZ 4", GLASS, "DIAM 5").replace("SURF 3", "SURF 4")
    plane = surface(3, "CURV 0.0", "DISZ 2.5", line, "DIAM 4")
    found = prescription_from_zemax(text.replace("SURF 4", plane + "SURF 4"))
    assert list(found["surfaces"]) == ["1", "2", "3"]
    assert found["sensor"]["distance"] == 2.5


def test_a_surface_that_another_configuration_has_is_left_out():
    """The sixth switch of HIDE: light, gap and number pass it over."""
    text = singlet("CURV 0.02", "DISZ 4", GLASS, "DIAM 5").replace("SURF 3", "SURF 4")
    text = text.replace("SURF 2", "SURF 3")
    extra = surface(2, "CURV 0.3", "DISZ 7", "GLAS MIRROR 0 0").replace(
        "HIDE 0 0 0 0 0 0", "HIDE 0 0 0 0 0 1"
    )
    found = prescription_from_zemax(text.replace("SURF 3", extra + "SURF 3"))
    assert list(found["surfaces"]) == ["1", "2"]
    assert found["surfaces"]["1"]["thickness"] == 4.0


PASSED_OVER = """SSID 3
VDSZ -1 1
VCON
VPAR 2
SCOL 1 0 0
TOLE 12 0
BOOK Page 3
TCED 23 0 0
POPS 1 0 0
WOBBLE 3
COAT AR
PPAR 3 -1 1 0"""


def test_what_bends_no_ray_is_passed_over_and_listed():
    lines = ("CURV 0.02", "DISZ 4", GLASS, "DIAM 5")
    plain = read_zemax(singlet(*lines))
    more = read_zemax(singlet(*lines, *PASSED_OVER.splitlines()))
    assert more.prescription == plain.prescription
    said = "; ".join(more.passed_over)
    for words in ("coatings (COAT)", "operands unknown here (WOBBLE)", "TCED", "physical optics"):
        assert words in said


def test_files_that_indent_nothing(tmp_path):
    text = "\n".join(line.strip() for line in triplet().splitlines())
    assert prescription_from_zemax(text) == prescription_from_zemax(triplet())


def test_a_distance_of_ten_million_metres_is_infinity():
    text = singlet("CURV 0.02", "DIAM 5", object_distance="1.0E+10")
    assert "object_distance" not in prescription_from_zemax(text)


def test_a_jones_matrix_is_a_plane_that_is_said_to_polarize(tmp_path):
    jones = surface(1, "STOP", "TYPE JONESMAT", "PARM 1 1", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0")
    text = (
        "ENPD 16\nFTYP 0 0 1 1\nYFLN 0\nWAVM 1 0.55 1\n"
        + surface(0, "DISZ INFINITY")
        + jones
        + surface(2, "CURV -0.05", "DISZ 39")
    )
    found = read_zemax(text + surface(3, ""))
    assert "polarization: the Jones matrix of surface 1" in found.passed_over
    assert found.prescription["surfaces"]["1"]["type"] == "plane"
    assert float(lens_of(text + surface(3, ""), tmp_path).first_order(550.0).efl) == pytest.approx(
        40
    )


@pytest.mark.parametrize("mode, listed", [(0, False), (1, True), (3, True)])
def test_the_opd_mode_of_a_paraxial_lens_is_listed(mode, listed):
    text = (
        "MODE SEQ\nENPD 4\nWAVM 1 0.55 1\nPWAV 1\nSURF 0\n  DISZ INFINITY\nSURF 1\n  STOP\n"
        f"  TYPE PARAXIAL\n  PARM 1 50\n  PARM 2 {mode}\n  DISZ 50\n  DIAM 2\nSURF 2\n  CURV 0\n"
    )
    found = read_zemax(text)
    assert any("OPD mode of a paraxial lens" in said for said in found.passed_over) == listed
