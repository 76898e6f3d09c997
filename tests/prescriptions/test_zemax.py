"""Zemax's .zmx format: what its files mean, and what is wrong with bad ones."""

import codecs
import math

import pytest
import torch

from dolens import InputError, Rays, Status, load_lens
from dolens.prescriptions.zemax import decode_zemax
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_writer import zemax_of
from tests.prescriptions.samples import require_refused

# The supplement's triplet, written as Zemax writes.
HEAD = """VERS 140124 258 36214
MODE SEQ
NAME Cooke triplet for 35 µm
NOTE 0 Supplement, Section III C
PFIL 0 0 0
LANG 0
UNIT MM X W X CM MR CPMM
FLOA
ENVD 2.0E+1 1 0
GFAC 0 0
GCAT SCHOTT MISC
RAIM 0.0 0 1 1 0 0 0 0 0
FTYP 0 0 3 3 0 0 0
ROPD 2
XFLN 0.0 0.0 0.0 0.0 0.0 0.0
YFLN 0.0 1.4E+1 2.0E+1 0.0 0.0 0.0
FWGN 1.0 1.0 1.0 1.0 1.0 1.0
VCXN 0.0 0.0 0.0 0.0 0.0 0.0
WAVM 1 4.861327E-1 1
WAVM 2 5.875618E-1 1
WAVM 3 6.562725E-1 1
WAVM 4 5.5E-1 1
PWAV 2
GLRS 1 0
"""
TRIPLET = [
    ("22.014", "3.259", "GLAS ___BLANK 1 0 1.6204 6.031E+1 0 0 0 0 0 0", "9.5"),
    ("-435.76", "6.008", "", "9.5"),
    ("-22.213", "1", "GLAS ___BLANK 1 0 1.62 3.637E+1 0 0 0 0 0 0", "4"),
    ("20.292", "4.75", "", "3.86"),
    ("79.684", "2.952", "GLAS ___BLANK 1 0 1.6204 6.031E+1 0 0 0 0 0 0", "7.5"),
    ("-18.395", "42.208", "", "7.5"),
]
TAIL = """BLNK
TOL TOFF   0   0 0.0000000000000000E+00 0.0000000000000000E+00   0 0 0 0 0
EFFL 0 2 0 0 0 0 50 1 0 0
MNUM 1 1
MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""
"""


def surface(n, *lines):
    common = ("FIMP ", "", "HIDE 0 0 0 0 0 0 0 0 0 0", "MIRR 2 0.0", "SLAB 3")
    return "".join([f"SURF {n}\n", *(f"  {line}\n" for line in (*common, *lines) if line)])


def standard(n, radius, thickness, glass="", semi_diameter="5", *more):
    return surface(
        n,
        *more,
        "TYPE STANDARD",
        f'CURV {1.0 / float(radius)!r} 0 0.0 0.0 0 ""',
        f"DISZ {thickness}",
        glass,
        f'DIAM {semi_diameter} 1 0 0 1 ""',
        f"FLAP 0 {semi_diameter} 0",
    )


def triplet():
    rows = [standard(n, *row, *(["STOP"] if n == 4 else [])) for n, row in enumerate(TRIPLET, 1)]
    target = surface(0, "TYPE STANDARD", "CURV 0.0", "DISZ INFINITY")
    image = surface(7, "TYPE STANDARD", "CURV 0.0", "DISZ 0", 'DIAM 18.173 1 0 0 1 ""')
    return "".join([HEAD, target, *rows, image, TAIL])


def singlet(*first, head="FLOA\n", last="DIAM 5", object_distance="INFINITY", image=""):
    """A file whose surface 1, the stop, has these lines."""
    return "".join(
        (
            head,
            surface(0, f"DISZ {object_distance}"),
            surface(1, "STOP", *first),
            surface(2, "CURV -0.02", "DISZ 40", last),
            surface(3, image),
        )
    )


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
    assert lens.fields == ("angles", ((0.0, 0.0), (0.0, 14.0), (0.0, 20.0)))
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


def lens_of(text, tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_text(text)
    return load_lens(path).requires_grad_(False)


GLASS = "GLAS ___BLANK 1 0 1.5168 64.17"


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
        ("GLAS N-BK7 0 0 1.5168 64.17 0 0 0 0 0 0", "N-BK7"),
        ("GLAS SSK4 0 0 1.5 40 0 0 0 0 0 0", "SSK4"),
        ("GLAS ___BLANK 1 0 1.51680 64.170 0 0 0 0 0 0", "1.51680/64.170"),
        ("GLAS ___BLANK 1 0 1.5168E+000 6.417E+1 0 0 0 0 0 0", "1.5168/64.17"),
        ("GLAS RESIN 1 0 1.53 56 0 0 0 0 0 0", "1.53/56"),
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


@pytest.mark.parametrize(("c", "k"), [(0.0, 0.0), (0.0, 3.0), (0.02, -1.0)])
def test_a_square_term_that_is_a_curvature(c, k, tmp_path):
    """On a plane or a paraboloid, α·r² makes a paraboloid: sag (c/2 + α)·r² + a4·r⁴."""
    alpha, a4 = 0.004, 1e-6
    text = singlet(
        "TYPE EVENASPH", f"CURV {c}", f"CONI {k}", f"PARM 1 {alpha}", f"PARM 2 {a4}", "DIAM 5"
    )
    lens = lens_of(text, tmp_path)
    shape = lens.surfaces["1"]
    r = torch.linspace(0.0, 5.0, 11, dtype=torch.float64)
    sag, *_ = shape.sag_and_gradient(dict(shape.named_parameters()), r, torch.zeros_like(r))
    expected = (c / 2 + alpha) * r**2 + a4 * r**4
    assert (sag - expected).abs().max() < 1e-15


def test_a_distance_of_ten_million_metres_is_infinity():
    text = singlet("CURV 0.02", "DIAM 5", object_distance="1.0E+10")
    assert "object_distance" not in prescription_from_zemax(text)


GOOD = ("CURV 0.02", "DISZ 4", GLASS, "DIAM 5")
BAD = {
    "coordinate break": (singlet("TYPE COORDBRK", *GOOD),
                         "surface 1: TYPE COORDBRK is not held (allowed: STANDARD, EVENASPH)"),
    "toroid": (singlet("TYPE BICONICX", *GOOD), "surface 1: TYPE BICONICX is not held"),
    "mirror": (singlet("CURV 0.02", "DIAM 5", "GLAS MIRROR 0 0"), "surface 1: GLAS MIRROR"),
    "spider": (singlet(*GOOD, "SPID 3 4"), "surface 1: operand SPID (line 18) is not held"),
    "half a rectangle": (singlet(*GOOD, "SQAP 3"), "surface 1: SQAP needs two numbers"),
    "decentred aperture": (singlet(*GOOD, "OBDC 0.1 0"), "surface 1: OBDC, a decentred aperture"),
    "ring": (singlet(*GOOD, "OBSC 1 2"), "surface 1: OBSC must be a full circle"),
    "floating ring": (singlet(*GOOD, "FLAP 1 5 0"), "surface 1: FLAP must be a full circle"),
    "several configurations": (singlet(*GOOD) + "MNUM 3 1\n", "MNUM 3: several configurations"),
    "non-sequential": (singlet(*GOOD, head="MODE NSC\n"), "MODE NSC is not held (allowed: SEQ)"),
    "image heights": (singlet(*GOOD, head="FTYP 3 0 1 1\nYFLN 5\n"),
                      "FTYP 3 (real image heights) is not held (allowed: 0, angles; 1, object"),
    "telecentric": (singlet(*GOOD, head="FTYP 0 1 1 1\nYFLN 5\n"), "telecentric object space"),
    "numerical aperture": (singlet(*GOOD, head="OBNA 0.1 0\n"),
                           "OBNA is not held (allowed: ENPD, FNUM, FLOA)"),
    "working F-number": (singlet(*GOOD, head="FNUM 4 1\n", object_distance="100"),
                         "FNUM as a working F-number is not held for a finite object"),
    "unknown unit": (singlet(*GOOD, head="UNIT PARSEC\n"),
                     "UNIT PARSEC is unknown (allowed: MM, CM, IN, METER)"),
    "no diameter": (singlet("CURV 0.02", "DISZ 4", GLASS),
                    "surface 1: DIAM is missing or 0; write the semi-diameter"),
    "no diameter behind the stop": (singlet(*GOOD, last="", head="ENPD 3\n"),
                                    "surface 2: DIAM is missing or 0"),
    "square term": (singlet("TYPE EVENASPH", "PARM 1 1E-3", *GOOD),
                    "surface 1: PARM 1, the r² term of EVENASPH, must be 0 unless"),
    "ninth coefficient": (singlet("TYPE EVENASPH", "PARM 9 1E-3", *GOOD),
                          "surface 1: PARM (line 15): must be from 1 to 8, not 9"),
    "coefficient of a sphere": (singlet("TYPE STANDARD", "PARM 2 1E-3", *GOOD),
                                "surface 1: TYPE STANDARD has no PARM"),
    "partial dispersion": (singlet("CURV 0.02", "DIAM 5", "GLAS ___BLANK 1 0 1.5 60 0.01"),
                           "surface 1: GLAS ___BLANK: the deviation of its dispersion"),
    "half a glass": (singlet("CURV 0.02", "DIAM 5", "GLAS ___BLANK 1 0 1.5"),
                     "surface 1: GLAS ___BLANK needs nd and Vd"),
    "words for numbers": (singlet("CURV big", "DIAM 5"),
                          "surface 1: CURV must be a number, not 'big'"),
    "nan": (singlet("CURV nan", "DIAM 5"), "surface 1: CURV must be a finite number, not 'nan'"),
    "out of range": (singlet("CURV 0.1", "DIAM 1e308", head="UNIT IN\n"),
                     "surface 1: DIAM is out of the range of double precision"),
    "endless gap": (singlet("CURV 0.1", "DIAM 5", "DISZ INFINITY"),
                    "surface 1: DISZ must be a finite number"),
    "no stop": (singlet(*GOOD).replace("  STOP\n", ""),
                "one surface from 1 to 2 must be the STOP, not none"),
    "two stops": (singlet(*GOOD, last="STOP\n  DIAM 5"), "must be the STOP, not 1, 2"),
    "missing number": (singlet(*GOOD).replace("SURF 2", "SURF 5"), "expected SURF 2, not 'SURF 5'"),
    "no surfaces": ("MODE SEQ\n", "needs an object, a surface and an image"),
    "round image": (singlet(*GOOD, image="CURV 0.1"), "surface 3 (the image): must be a plane"),
    "round object": (singlet(*GOOD).replace("SURF 1", "  CURV 0.1\nSURF 1"),
                     "surface 0 (the object): must be a plane"),
    "primary wavelength": (singlet(*GOOD, head="WAVM 1 0.55 1\nPWAV 2\n"),
                           "PWAV 2 is none of the wavelengths 1 to 1"),
    "too few fields": (singlet(*GOOD, head="FTYP 0 0 3 1\nYFLN 0 5\n"), "FTYP says 3 fields"),
    "heights at infinity": (singlet(*GOOD, head="FTYP 1 0 1 1\nYFLN 5\n"),
                            "'fields.heights' need an 'object_distance'"),
    "aperture beyond the sphere": (singlet("CURV 0.2", "DIAM 6", GLASS),
                                   "surface 1: semi_diameter 6 mm exceeds"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files(case, tmp_path):
    require_refused(tmp_path / "bad.zmx", *BAD[case])


def test_the_good_file_is_good(tmp_path):
    lens = lens_of(singlet(*GOOD), tmp_path)
    n = lens.materials[1].index(587.5618)
    power = 2 * (n - 1) * 0.02 - (n - 1) ** 2 * 0.02**2 * 4 / n
    assert float(lens.first_order().efl) == pytest.approx(1 / power, rel=1e-12)
    assert math.isclose(n, 1.5168, rel_tol=1e-15)


@pytest.mark.parametrize("data", [b"\xff\xfe\x00", b"\xef\xbb\xbf\xff", b"SURF 0\0\0\0"])
def test_files_that_are_no_text(data):
    with pytest.raises(InputError, match=r"^x\.zmx: is no"):
        decode_zemax(data, "x.zmx")


APERTURES = {
    "rectangle": {"aperture": {"half_width_x": 5.0, "half_width_y": 4.0}},
    "ring": {"semi_diameter": 5.0, "obscuration": {"semi_diameter": 2.0}},
    "rectangular hole": {"semi_diameter": 5.0,
                         "obscuration": {"half_width_x": 1.0, "half_width_y": 2.0}},
}  # fmt: skip
WRITTEN = {
    "rectangle": "SQAP 5.0 4.0",
    "ring": "CLAP 2.0 5.0 0",
    "rectangular hole": "SQOB 1.0 2.0",
}


@pytest.mark.parametrize("shape", APERTURES)
def test_apertures_of_every_shape_come_back(shape):
    first = {"radius": 30.0, "thickness": 3.0, "material": "1.5168/64.17"}
    last = {"radius": -30.0, "semi_diameter": 6.0, "material": "air"}
    lens = {"name": "Singlet", "sensor": {"distance": 25.0},
            "surfaces": {"1": first | APERTURES[shape], "2": last}}  # fmt: skip
    text = zemax_of(lens)
    assert WRITTEN[shape] in text
    row = prescription_from_zemax(text)["surfaces"]["1"]
    assert {key: row.get(key) for key in ("semi_diameter", "aperture", "obscuration")} == {
        "semi_diameter": None, "aperture": None, "obscuration": None
    } | APERTURES[shape]  # fmt: skip


def test_a_rectangle_with_a_hole_is_refused():
    row = APERTURES["rectangle"] | {"obscuration": {"semi_diameter": 1.0}}
    row |= {"radius": 30.0, "material": "1.5168/64.17"}
    with pytest.raises(InputError, match=r"surface 1: a \.zmx file cannot hold 'obscuration'"):
        zemax_of({"surfaces": {"1": row}, "sensor": {"distance": 25.0}})


def test_an_aperture_is_in_the_file_s_units():
    text = singlet("CURV 0.1", "DIAM 5", "SQAP 0.5 0.25", GLASS, head="UNIT IN\nFLOA\n")
    row = prescription_from_zemax(text)["surfaces"]["1"]
    assert row["aperture"] == {"half_width_x": 12.7, "half_width_y": 6.35}
