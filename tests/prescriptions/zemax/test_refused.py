"""Zemax files that are no lens, and what is said of them."""

import math

import pytest

from dolens import InputError
from dolens.files import decode_text
from tests.prescriptions.samples import require_refused
from tests.prescriptions.zemax.samples import GLASS, lens_of, singlet

GOOD = ("CURV 0.02", "DISZ 4", GLASS, "DIAM 5")


BAD = {
    "superconic": (singlet("TYPE SUPERCON", *GOOD),
                   "surface 1: a superconic is not held (TYPE SUPERCON; allowed: "),
    "gradient index": (singlet("TYPE GRINSUR7", *GOOD), "surface 1: a gradient-index medium of"),
    "non-sequential part": (singlet("TYPE NONSEQCO", *GOOD, "NSCS 1 7 _NONE_"),
                            "surface 1: a non-sequential component is not held"),
    "Fresnel lens": (singlet("TYPE FRESNELS", *GOOD), "surface 1: a Fresnel surface is not held"),
    "new type": (singlet("TYPE WOBBLE", *GOOD),
                 "surface 1: a kind of surface that is not known here is not held (TYPE WOBBLE"),
    "own axes": (singlet(*GOOD, "SCBD 1 0 0 0.0 0.1 0.0 0.0 0.0\n  SCBD 2 0 1 0 0.2 0 0 0"),
                 "surface 1: SCBD: the tilts and decenters after the surface are not those before"),
    "axes of the object": (singlet(*GOOD).replace("SURF 1", "  SCBD 2 0 0 0 1 0 0 0\nSURF 1"),
                           "the object: a decentred or tilted object is not held (SCBD)"),

    "spider": (singlet(*GOOD, "SPID 3"), "surface 1: SPID needs the width of the arms"),
    "drawn outline": (singlet(*GOOD, "USAP 0 0 0"),
                      "surface 1: USAP: the outline that the user draws stands in another file"),
    "half a rectangle": (singlet(*GOOD, "SQAP 3"), "surface 1: SQAP needs two numbers"),
    "ring": (singlet(*GOOD, "OBSC 2 1"), "surface 1: 'obscuration': inner_semi_diameter 2 must"),
    "configurations": (singlet(*GOOD) + "MNUM 2.5 1\n",
                       "MNUM must have whole numbers, not '2.5 1'"),
    "non-sequential": (singlet(*GOOD, head="MODE NSC\n"),
                       "a non-sequential system is not held (MODE NSC; allowed: SEQ)"),
    "theodolite angles": (singlet(*GOOD, head="FTYP 4 0 1 1\nYFLN 5\n"),
                          "FTYP 4: theodolite angles are not held (allowed: 0, 1, 2, 3)"),
    "unknown fields": (singlet(*GOOD, head="FTYP 9 0 1 1\nYFLN 5\n"), "FTYP 9: is an unknown kind"),
    "image heights of a window": (singlet("CURV 0.0", GLASS, head="FTYP 2 0 1 1\nYFLN 5\nENPD 3\n")
                                  .replace("CURV -0.02", "CURV 0.0"),
                                  "fields by their image heights need a lens that forms an image"),
    "image height out of reach": (singlet(*GOOD, head="FTYP 3 0 1 1\nYFLN 5E5\nENPD 3\n"),
                                  "no chief ray lands at the real image height 500000 mm"),
    "telecentric and endless": (singlet(*GOOD, head="FTYP 0 1 1 1\nYFLN 5\n"),
                                "a telecentric object space needs a finite object"),
    "not telecentric": (singlet(*GOOD, head="FTYP 1 1 1 1\nYFLN 5\nENPD 3\n", object_distance="90"),
                        "'telecentric_object': the image of the stop in object space lies"),
    "numerical aperture of infinity": (singlet(*GOOD, head="OBNA 0.1 0\n"),
                                       "aperture in object space needs a finite object"),
    "numerical aperture beyond air": (singlet(*GOOD, head="OBNA 1.1 0\n", object_distance="90"),
                                      "'object_na' must be below the index 1 of the"),
    "cone of a half space": (singlet(*GOOD, head="OBNA 90 1\n", object_distance="90"),
                             "light at 90 degrees to the axis and more is not held"),
    "negative pupil": (singlet(*GOOD, head="ENPD -3\n"), "ENPD must be positive, not -3"),
    "unknown unit": (singlet(*GOOD, head="UNIT PARSEC\n"),
                     "UNIT PARSEC is unknown (allowed: MM, CM, IN, METER)"),
    "stop without a size": (singlet("CURV 0.02", "DISZ 4", GLASS),
                            "surface 1: the stop has no size: neither its DIAM nor the system's"),
    "18th power but one": (singlet("TYPE EVENASPH", "PARM 17 1E-3", *GOOD),
                           "surface 1: PARM 17 is 1E-3, but TYPE EVENASPH has PARM 1 to 16"),
    "half a coefficient": (singlet("TYPE EVENASPH", "PARM 2", *GOOD),
                           "surface 1: PARM (line 15): needs a number from 1 and a value"),
    "negative coefficient": (singlet("TYPE EVENASPH", "PARM -2 1", *GOOD),
                             "surface 1: PARM (line 15): must have a whole number from 0, not -2"),
    "bent polynomial": (singlet("TYPE XPOLYNOM", "XDAT 1 1", "XDAT 2 1", "XDAT 3 1E-3", *GOOD),
                        "surface 1: a conic plus a polynomial in x and y is not held"),
    "no radius": (singlet("TYPE XPOLYNOM", "XDAT 1 1", "XDAT 2 0", "XDAT 3 1E-3", "DIAM 5"),
                  "surface 1: XDAT 2, the radius of normalization, must be positive"),
    "endless polynomial": (singlet("TYPE XPOLYNOM", "XDAT 1 1E9", "XDAT 2 1", "DIAM 5"),
                           "surface 1: XDAT 1 must be a number of terms from 0 to 230"),
    "lines behind": (singlet(*GOOD) + "EFFL 0 2\nCURV 0.1\n", ": CURV stands behind the surfaces"),
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
    "aspheric image": (singlet(*GOOD, image="TYPE EVENASPH\n  CURV 0.1\n  PARM 2 1e-5"),
                       "the image: an aspheric image is not held"),
    "primary wavelength": (singlet(*GOOD, head="WAVM 1 0.55 1\nPWAV 2\n"),
                           "PWAV 2 is none of the wavelengths 1 to 1"),
    "heights at infinity": (singlet(*GOOD, head="FTYP 1 0 1 1\nYFLN 5\n"),
                            "'fields.heights' need an 'object_distance'"),
    "aperture beyond the sphere": (singlet("CURV 0.2", "CLAP 0 6 0", GLASS),
                                   "surface 1: semi_diameter 6 mm exceeds"),
}  # fmt: skip


# Type, its lines, and what is said of them.
SHAPES = [
    ("FZERNSAG", ("PARM 0 0", "XDAT 1 4", "XDAT 2 4"), "the aperture reaches 5 mm"),
    ("FZERNSAG", ("XDAT 1 38", "XDAT 2 9"), "terms from 0 to 37, not 38"),
    ("SZERNSAG", ("XDAT 1 4",), "XDAT 2, the normalization radius, must be positive"),
    ("TOROIDAL", ("PARM 1 30", "XDAT 4 0.1"), "Zernike polynomials on a toroid"),
    ("QED_TYPE", ("XDAT 1 2", "XDAT 3 5"), "XDAT 1 must be 0 "),
    ("ODDASPHE", ("PARM 9 1",), "PARM 9 is 1, but TYPE ODDASPHE has PARM 1 to 8"),
    ("BICONICX", ("PARM 3 1",), "PARM 3 is 1"),
    ("BINARY_2", ("XDAT 1 1", "XDAT 2 1", "XDAT 3 5"), "PARM 0, the order of diffraction"),
    ("BINARY_2", ("PARM 0 0.5",), "must be a whole number"),
    ("BINARY_2", ("PARM 0 1", "XDAT 1 1", "XDAT 2 0"), "XDAT 2, the radius"),
    ("BINARY_1", ("PARM 0 1", "XDAT 1 999"), "number of terms from 0 to 230"),
    ("DGRATING", ("PARM 1 0.6", "PARM 2 1", "PARM 3 4.0"), "PARM 3 is 4.0"),
    ("PARAXIAL", ("PARM 1 0",), "focal length of a PARAXIAL lens, is 0"),
    ("BINARY_3", ("PARM 0 1",), "a diffractive phase is not held"),
    ("PARAX_XY", ("PARM 1 1",), "a paraxial lens of two focal lengths is not held"),
    ("IRREGULA", ("PARM 3 0.1",), "own decenter or tilt"),
    ("IRREGULA", ("PARM 6 0.1", "PARM 8 45"), "turned about the axis"),
    ("FZERNPHA", ("PARM 1 1", "XDAT 1 4", "XDAT 2 1"), "PARM 0, the order of diffraction"),
    ("FZERNPHA", ("PARM 0 1", "XDAT 1 4", "XDAT 2 2.5"), "which ends at 2.5 mm"),
    ("SZERNPHA", ("PARM 0 1", "XDAT 1 92", "XDAT 2 1"), "a number of terms from 0 to 91"),
]
BAD |= {
    f"{kind} {lines}": (singlet(f"TYPE {kind}", *lines, *GOOD), said)
    for kind, lines, said in SHAPES
}


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
        decode_text(data, "x.zmx")
