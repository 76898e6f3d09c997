"""Zemax files that are no lens, and what is said of them."""

import math

import pytest

from dolens import InputError
from dolens.prescriptions.zemax import decode_zemax
from tests.prescriptions.samples import require_refused
from tests.prescriptions.zemax_samples import GLASS, lens_of, singlet

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
    "partial dispersion": (singlet("CURV 0.02", "DIAM 5", "GLAS ___BLANK 1 0 1.5 60 4.0"),
                           "surface 1: GLAS ___BLANK: ΔPgF must be from -1 to 1"),
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
