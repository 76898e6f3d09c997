"""Zemax's .zmx format: what its files mean."""

import codecs

import pytest
import torch

from dolens import Rays, Status, load_lens
from dolens.optics.fields import Fields
from dolens.prescriptions.zemax.reader import prescription_from_zemax, read_zemax
from tests.prescriptions.zemax_samples import GLASS, lens_of, singlet, surface, triplet


def numbers(rows):
    return torch.tensor([[float(v) for v in row] for row in rows], dtype=torch.float64)


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


def test_the_triplet_traces_as_the_reference(tmp_path, reference):
    """28-digit rays of the supplement's triplet through the same lens read from a .zmx file."""
    path = tmp_path / "triplet.ZMX"
    path.write_bytes(ENCODED["UTF-16 LE"](triplet()))
    lens = load_lens(path)
    assert lens.stop == 4
    assert lens.wavelengths == (486.1327, 587.5618, 656.2725)
    assert lens.reference_wavelength == 587.5618
    assert lens.fields == Fields("angles", ((0.0, 0.0), (0.0, 14.0), (0.0, 20.0)))
    assert lens.sensor_diameter == 36.346
    rays = reference("rays/rays_triplet__dfc.json")["rays"]
    hit = lens.trace(
        Rays(
            numbers(r["o"] for r in rays),
            numbers(r["d"] for r in rays),
            torch.tensor([float(r["wavelength"]) for r in rays], dtype=torch.float64),
        )
    )
    ok = torch.tensor([r["status"] == "ok" for r in rays])
    assert torch.equal(hit.valid, ok)
    assert torch.equal(hit.status == Status.OK, ok)
    assert int(ok.sum()) > 50
    expected = numbers(r["sensor"] for r in rays if r["status"] == "ok")
    assert (hit.position[ok][:, : expected.shape[1]] - expected).abs().max() < 1e-11


def test_what_a_file_says_of_its_system():
    found = prescription_from_zemax(triplet())
    assert found["source"] == "Supplement, Section III C"
    assert found["index_model"] == "dfc"
    assert "object_distance" not in found
    assert found["surfaces"]["3"] == {
        "type": "sphere", "radius": -22.213, "material": "1.62/36.37", "semi_diameter": 4.0,
        "thickness": 1.0,
    }  # fmt: skip


UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}


@pytest.mark.parametrize("unit", UNITS)
def test_units(unit):
    """A length u·r in mm; the coefficient of r^2i in mm^(1-2i) is u^(1-2i) of the file's."""
    u = UNITS[unit]
    text = singlet(
        "TYPE EVENASPH", "CURV 0.02", "CONI -0.5", "PARM 2 1E-6", "PARM 3 -2E-9", "DISZ 4",
        "GLAS ___BLANK 1 0 1.5 60", "DIAM 5", head=f"UNIT {unit}\nENPD 8\nFTYP 1 0 1 1\nYFLN 3\n"
        "WAVM 1 0.55 1\n", object_distance="200", image="DIAM 7 1",
    )  # fmt: skip
    found = prescription_from_zemax(text)
    first, second = found["surfaces"].values()
    assert first["radius"] == pytest.approx(50.0 * u, rel=1e-15)
    assert first["a4"] == pytest.approx(1e-6 * u**-3, rel=1e-15)
    assert first["a6"] == pytest.approx(-2e-9 * u**-5, rel=1e-15)
    assert first["thickness"] == pytest.approx(4.0 * u, rel=1e-15)
    assert second["semi_diameter"] == pytest.approx(5.0 * u, rel=1e-15)
    assert found["sensor"] == pytest.approx({"distance": 40.0 * u, "diameter": 14.0 * u}, rel=1e-15)
    assert found["object_distance"] == pytest.approx(200.0 * u, rel=1e-15)
    assert found["entrance_pupil_diameter"] == pytest.approx(8.0 * u, rel=1e-15)
    assert found["fields"] == {"heights": [[0.0, pytest.approx(3.0 * u, rel=1e-15)]]}
    assert found["wavelengths"] == [550.0]


def test_wavelengths_are_the_nearest_doubles_in_nm():
    text = singlet("CURV 0.02", "DIAM 5", head="WAVL 0.4861327 0.5875618 0.6562725\nPWAV 3\n")
    found = prescription_from_zemax(text)
    assert found["wavelengths"] == [486.1327, 587.5618, 656.2725]
    assert found["reference_wavelength"] == 656.2725


@pytest.mark.parametrize("diam", ["", "DIAM 0", "DIAM 12 0", "DIAM 12 1"])
def test_the_beam_sizes_the_stop(diam, tmp_path):
    """ENPD and FNUM say the beam; a DIAM that does not clip in Zemax does not enlarge it."""
    lines = ("CURV 0.02", "DISZ 4", GLASS, diam)
    lens = lens_of(singlet(*lines, head="ENPD 8\n"), tmp_path)
    assert lens.surfaces["1"].semi_diameter == pytest.approx(4.0, rel=1e-12)
    lens = lens_of(singlet(*lines, head="FNUM 5 0\n"), tmp_path)
    assert float(lens.first_order().f_number) == pytest.approx(5.0, rel=1e-12)


def test_a_clipping_stop_stays_as_small_as_it_is(tmp_path):
    lines = ("CURV 0.02", "DISZ 4", GLASS, "DIAM 12", "CLAP 0 3 0")
    assert lens_of(singlet(*lines, head="ENPD 8\n"), tmp_path).surfaces["1"].semi_diameter == 3.0


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


@pytest.mark.parametrize(
    ("glas", "material"),
    [
        ("", "air"),
        ("GLAS AIR", "air"),
        ("GLAS N-BK7 0 0 1.5168 64.17 0 0 0 0 0 0", "SCHOTT:N-BK7"),
        ("GLAS S-BSL7 0 0 1.5 40 0 0 0 0 0 0", "OHARA:S-BSL7"),
        ("GLAS ___BLANK 1 0 1.51680 64.170 0 0 0 0 0 0", "1.51680/64.170/0"),
        ("GLAS ___BLANK 1 0 1.51680 64.170 0.005098803673", "1.51680/64.170"),
        ("GLAS ___BLANK 1 0 1.5168E+000 6.417E+1 0 0 0 0 0 0", "1.5168/64.17/0"),
        ("GLAS RESIN 1 0 1.53 56 0 0 0 0 0 0", "1.53/56/0"),
        ("GLAS ___BLANK 1 0 1.5 0 0 0 0 0 0 0", "1.5"),
    ],
)
def test_glass_by_model_or_by_name(glas, material):
    found = prescription_from_zemax(singlet("CURV 0.02", "DIAM 5", glas))
    assert found["surfaces"]["1"]["material"] == material


def test_unused_coefficients_are_not_parameters():
    """Zemax lists all eight, used or not."""
    parm = [f"PARM {n} {1e-6 if n == 3 else 0}" for n in range(1, 9)]
    found = prescription_from_zemax(singlet("TYPE EVENASPH", "CURV 0.02", "DIAM 5", *parm))
    row = found["surfaces"]["1"]
    assert {key: row[key] for key in row if key[0] == "a"} == {"a4": 0.0, "a6": 1e-6}


@pytest.mark.parametrize(("c", "k"), [(0.0, 0.0), (0.0, 3.0), (0.02, -1.0), (0.04, 0.5)])
def test_a_square_term_is_a_coefficient(c, k, tmp_path):
    """The sag is the conic's, plus α·r² + a4·r⁴."""
    alpha, a4 = 0.004, 1e-6
    text = singlet(
        "TYPE EVENASPH", f"CURV {c}", f"CONI {k}", f"PARM 1 {alpha}", f"PARM 2 {a4}", "DIAM 5"
    )
    lens = lens_of(text, tmp_path)
    shape = lens.surfaces["1"]
    r = torch.linspace(0.0, 5.0, 11, dtype=torch.float64)
    sag, *_ = shape.sag_and_gradient(dict(shape.named_parameters()), r, torch.zeros_like(r))
    conic = c * r**2 / (1 + (1 - (1 + k) * c**2 * r**2).sqrt())
    assert (sag - conic - alpha * r**2 - a4 * r**4).abs().max() < 1e-15


def test_a_tilted_plane_is_a_polynomial():
    found = prescription_from_zemax(singlet("TYPE TILTSURF", "PARM 1 0.1", "PARM 2 -0.2", "DIAM 5"))
    row = found["surfaces"]["1"]
    assert (row["type"], row["x"], row["y"]) == ("xy_polynomial", 0.1, -0.2)


def test_a_polynomial_is_read_with_its_radius_of_normalization():
    """A coefficient A of (x/R)²·(y/R), a length u·A, is u·A/(u·R)³ in mm^-2."""
    data = [5.0, 2.0, *(0.0,) * 5, 8.0]
    lines = [f"XDAT {n} {value}" for n, value in enumerate([6, *data[1:]], 1)]
    text = singlet("TYPE XPOLYNOM", *lines, "DIAM 5", head="UNIT CM\nFLOA\n")
    row = prescription_from_zemax(text)["surfaces"]["1"]
    assert row["x3"] == pytest.approx(8.0 * 10.0 / 20.0**3, rel=1e-15)


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


def test_the_current_configuration_is_the_lens_itself():
    """Others are its states; see tests/prescriptions/test_states.py."""
    text = singlet("CURV 0.02", "DISZ 4", GLASS, "DIAM 5")
    more = "MNUM 2 1\nTHIC 1 1 4.0 0\nTHIC 1 2 5.0 0\nCRVT 2 1 -0.02\nCRVT 2 2 -0.02\n"
    found = read_zemax(text + more).prescription
    assert found["surfaces"]["1"]["thickness"] == 4.0
    gaps = {n: state["surfaces"]["1"]["thickness"] for n, state in found["states"].items()}
    assert gaps == {"c1": 4.0, "c2": 5.0}


def test_files_that_indent_nothing(tmp_path):
    text = "\n".join(line.strip() for line in triplet().splitlines())
    assert prescription_from_zemax(text) == prescription_from_zemax(triplet())


def test_a_distance_of_ten_million_metres_is_infinity():
    text = singlet("CURV 0.02", "DIAM 5", object_distance="1.0E+10")
    assert "object_distance" not in prescription_from_zemax(text)
