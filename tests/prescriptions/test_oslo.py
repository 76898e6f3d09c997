"""OSLO's .len format: what its files mean, and what is refused."""

import pytest

from dolens import load_lens
from dolens.prescriptions.oslo import read_oslo
from tests.prescriptions.codev.samples import TRIPLET as CODE_V_TRIPLET
from tests.prescriptions.samples import require_refused, require_same_parameters

# The supplement's triplet, as OSLO writes.
TRIPLET = """// OSLO 6.6 55487     0 50466
LEN NEW "Cooke triplet" 50.0 7
EBR  5.1
ANG  20.0
DES  "OSLO"
UNI  1.0
// SRF 0
AIR
TH   1.0e+20
AP   3.6e+19
NXT  // SRF 1
GLA 620603
RD   22.014
TH   3.259
AP CHK 9.5
NXT  // SRF 2
AIR
RD   -435.76
TH   6.008
AP CHK 9.5
NXT  // SRF 3
GLA 620364
RD   -22.213
TH   1.0
AP CHK 4.0
NXT  // SRF 4
AIR
RD   20.292
TH   4.75
AST
AP CHK 3.86
NXT  // SRF 5
GLA 620603
RD   79.684
TH   2.952
AP CHK 7.5
NXT  // SRF 6
AIR
RD   -18.395
TH   42.208
PY   0.0
AP CHK 7.5
NXT  // SRF 7
AIR
TH   0.0
CBK  1
WV 0.58756 0.48613 0.65627
WW 1.0 1.0 1.0
END  7
DLRS 3
VAR NEW
V 1 2 0 CV 0.0 0.0 1.0 0.00008
"""
EDGE = "NXT  // SRF 7\nAIR\n"


def changed(old, new):
    assert old in TRIPLET
    return TRIPLET.replace(old, new)


def test_the_same_lens_in_codes_of_glass_is_the_same_in_code_v(tmp_path):
    """Both programs write nd 1.620 and Vd 60.3 as 620603."""
    other = CODE_V_TRIPLET.replace("620400.603100", "620603").replace("620000.363700", "620364")
    own = changed("WV 0.58756 0.48613 0.65627", "WV 0.5875618 0.4861327 0.6562725")
    lenses = []
    for name, text in (("lens.len", own), ("lens.seq", other)):
        (tmp_path / name).write_text(text)
        lenses.append(load_lens(tmp_path / name))
    require_same_parameters(*lenses)
    assert [(m.a, m.b) for m in lenses[0].materials] == [(m.a, m.b) for m in lenses[1].materials]
    assert [s.semi_diameter for s in lenses[0].surfaces.values()] == [
        s.semi_diameter for s in lenses[1].surfaces.values()
    ]
    assert lenses[0].stop == lenses[1].stop == 4


def test_what_a_file_says_of_its_system():
    found, said = read_oslo(TRIPLET, "lens")
    assert found["name"] == "Cooke triplet"
    assert found["wavelengths"] == [587.56, 486.13, 656.27]
    assert found["reference_wavelength"] == 587.56
    assert found["fields"] == {"angles": [[0.0, 0.0], [0.0, 20.0]]}
    assert found["entrance_pupil_diameter"] == 10.2
    assert "object_distance" not in found
    assert said == [
        "solves, whose values are written",
        "names and drawing (DES)",
        "settings of the program (CBK)",
    ]


@pytest.mark.parametrize("u", [1.0, 10.0, 25.4])
def test_units_and_aspheres(u):
    text = changed("RD   22.014", "RD 20\nCC -0.5\nAD 1e-6\nAE -2e-9\nAH 3e-18")
    row = read_oslo(text.replace("UNI  1.0", f"UNI {u}"), "lens").prescription["surfaces"]["1"]
    assert row["type"] == "even_asphere"
    assert row["conic"] == -0.5
    for key, value, power in (("radius", 20.0, 1), ("a4", 1e-6, -3), ("a12", 3e-18, -11)):
        assert row[key] == pytest.approx(value * u**power, rel=1e-14)


def test_apertures_that_are_not_checked_do_not_clip():
    found = read_oslo(changed("AP CHK 9.5", "AP 9.5"), "lens").prescription
    assert found["surfaces"]["1"]["clips"] is False
    found = read_oslo(changed("AP CHK 7.5\n", ""), "lens").prescription
    assert found["surfaces"]["5"]["semi_diameter"] == "auto"


def test_mirrors():
    text = changed("GLA 620364\n", "RFH\n")
    assert read_oslo(text, "lens").prescription["surfaces"]["3"]["material"] == "mirror"


REFUSED = [
    ("AST\n", "AST\nTLA 5.0\n", "a decentred or tilted surface is not held (TLA)"),
    ("AST\n", "AST\nDCY 5.0\n", "a decentred or tilted surface is not held (DCY)"),
    ("AST\n", "AST\nASP ASR 4\n", "a general aspheric surface is not held (ASP)"),
    ("AST\n", "AST\nFOO 4\n", "command FOO is not known, and may bend rays"),
    ("GLA 620364", "GLA OWN 1.5 1.6 1.7", "a glass by its own indices is not held (GLA OWN)"),
    ("GLA 620364", "GLA NOSUCH", "glass NOSUCH is not known here"),
    ("TH   42.208", "TH   0.0", "its gap is left to a solve"),
    (TRIPLET[TRIPLET.index("END") :], "", "ends without END"),
    ("LEN NEW", "BEL NEW", "expected LEN NEW, not BEL"),
    ("UNI  1.0", "UNI  0", "UNI must be positive"),
    ("TH   1.0e+20", "TH 100", "a beam radius on surface 1 is not held for a near object"),
    ("RD   -435.76", f"RD {'9' * 5000}", "must be a number, not 5000 letters"),
    ("RD   -435.76", "RD 1\n" + "NXT\n" * 2100, "more than 2000 surfaces"),
]


def test_an_image_without_a_gap_of_its_own():
    file = changed("AIR\nTH   0.0\nCBK", "AIR\nTH\nCBK")
    assert read_oslo(file, "lens").prescription["sensor"]["distance"] == 42.208


@pytest.mark.parametrize(("old", "new", "said"), REFUSED)
def test_what_is_not_held_is_refused_by_name(old, new, said, tmp_path):
    require_refused(tmp_path / "lens.len", changed(old, new), said)
