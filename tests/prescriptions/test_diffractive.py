"""Gratings, diffractive phases and ideal lenses in prescriptions and Zemax files."""

import math

import pytest

from dolens import InputError
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_writer import zemax_of

RADIAL = {"type": "radial", "order": 1, "norm_radius": 10.0, "p2": -1133.351455930, "p4": 341.9}
XY = {"type": "xy", "order": -2, "norm_radius": 5.0, "x": 12.5, "x2y": -3.0, "y4": 0.0}
GRATING = {"type": "grating", "order": -1, "grooves": 600.25}


def prescription(*rows):
    rows = [{"semi_diameter": 5.0, "material": "air", "thickness": 3.0, **row} for row in rows]
    del rows[-1]["thickness"]
    return {
        "name": "deflections",
        "wavelengths": [587.5618],
        "fields": {"angles": [[0.0, 0.0]]},
        "surfaces": {str(i): row for i, row in enumerate(rows, 1)},
        "sensor": {"distance": 20.0},
    }


EVERY = prescription(
    {"type": "sphere", "radius": 50.0, "material": "SCHOTT:N-BK7", "phase": RADIAL},
    {"type": "even_asphere", "radius": -70.0, "conic": -0.5, "a4": 1e-6, "phase": XY},
    {"type": "plane", "phase": GRATING},
    {"type": "conic", "radius": 90.0, "conic": -1.0, "phase": {**GRATING, "order": 2}},
    {"type": "paraxial_lens", "focal_length": 30.0},
)


def test_a_lens_is_written_as_it_was_read():
    lens = lens_from_prescription(EVERY)
    again = prescription_of(lens)
    for number, row in EVERY["surfaces"].items():
        for key, value in row.items():
            assert again["surfaces"][number][key] == value
    names = [name for name, _ in lens.named_parameters()]
    assert "surfaces.1.phase.p4" in names
    assert "surfaces.3.phase.grooves" in names
    assert not [name for name in names if "order" in name or "norm_radius" in name]


def test_a_zemax_file_holds_them_all():
    text = zemax_of(EVERY)
    for kind in ("BINARY_2", "BINARY_1", "DGRATING", "PARAXIAL"):
        assert f"TYPE {kind}" in text
    back = prescription_from_zemax(text)
    assert back["surfaces"]["3"]["phase"] == GRATING
    assert back["surfaces"]["1"]["phase"] == RADIAL
    assert back["surfaces"]["2"]["phase"]["y4"] == 0.0
    assert back["surfaces"]["5"]["focal_length"] == 30.0


def test_efficiency_is_data_that_a_zemax_file_does_not_hold():
    row = {"type": "plane", "phase": {**GRATING, "efficiency": 0.83}}
    lens = lens_from_prescription(prescription(row))
    assert lens.surfaces["1"].phase.efficiency == 0.83
    assert prescription_of(lens)["surfaces"]["1"]["phase"]["efficiency"] == 0.83
    with pytest.raises(InputError, match="cannot hold 'phase'"):
        zemax_of(prescription(row))


FILE = """VERS 140124 258 36214
MODE SEQ
UNIT IN X W X CM MR CPMM
ENPD 0.5
GCAT SCHOTT
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 0
WAVM 1 0.55 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ INFINITY
  DIAM 0
SURF 1
  STOP
  TYPE {type}
  CURV 0.1
{lines}
  DISZ 1.0
  GLAS N-BK7 0 0 1.5 40
  DIAM 0.4 1 0 0 1 ""
SURF 2
  TYPE STANDARD
  CURV -0.05
  DISZ 4.0
  DIAM 0.4 1 0 0 1 ""
SURF 3
  TYPE STANDARD
  CURV 0.0
  DISZ 0
  DIAM 0.1
"""


def first_row(kind, *lines):
    text = FILE.format(type=kind, lines="\n".join(f"  {line}" for line in lines))
    return prescription_from_zemax(text)["surfaces"]["1"]


def test_a_file_in_inches_scales_lengths_and_not_radians():
    row = first_row(
        "BINARY_2", "PARM 0 1", "PARM 2 0", "XDAT 1 2", "XDAT 2 0.5", "XDAT 3 -700.5", "XDAT 4 0"
    )
    assert row["type"] == "sphere"
    assert row["phase"] == {"type": "radial", "order": 1, "norm_radius": 12.7, "p2": -700.5}
    row = first_row("DGRATING", "CONI -1", "PARM 1 0.6", "PARM 2 -1")
    assert row["phase"] == {"type": "grating", "order": -1, "grooves": 600.0}
    assert row["conic"] == -1.0
    assert first_row("PARAXIAL", "PARM 1 2.0", "PARM 2 1")["focal_length"] == 50.8
    row = first_row("BINARY_1", "PARM 0 -1", "PARM 2 1e-3", "XDAT 1 3", "XDAT 2 1", "XDAT 5 4.5")
    assert row["type"] == "even_asphere"
    assert row["phase"] == {"type": "xy", "order": -1, "norm_radius": 25.4, "x2": 4.5}


@pytest.mark.parametrize(
    "kind, lines, wrong",
    [
        ("BINARY_2", ("XDAT 1 1", "XDAT 2 1", "XDAT 3 5"), "PARM 0, the order of diffraction"),
        ("BINARY_2", ("PARM 0 0.5",), "must be a whole number"),
        ("BINARY_2", ("PARM 0 1", "XDAT 1 1", "XDAT 2 0"), "XDAT 2, the radius"),
        ("BINARY_1", ("PARM 0 1", "XDAT 1 999"), "number of terms from 0 to 230"),
        ("DGRATING", ("PARM 1 0.6", "PARM 2 1", "PARM 3 4.0"), "PARM 3 is 4.0"),
        ("PARAXIAL", ("PARM 1 0",), "focal length of a PARAXIAL lens, is 0"),
        ("BINARY_3", ("PARM 0 1",), "a diffractive phase is not held"),
        ("PARAX_XY", ("PARM 1 1",), "a paraxial lens of two focal lengths is not held"),
    ],
)
def test_what_a_file_says_wrong_is_named(kind, lines, wrong):
    with pytest.raises(InputError, match=wrong):
        first_row(kind, *lines)


@pytest.mark.parametrize(
    "row, wrong",
    [
        ({"phase": {"type": "grateing", "grooves": 1.0}}, "type 'grateing' is unknown"),
        ({"phase": {"type": "grating"}}, "needs 'grooves'"),
        ({"phase": {"type": "radial", "p3": 1.0}}, "'p3': coefficients of a radial phase"),
        ({"phase": {"type": "radial", "q2": 1.0}}, "'q2'"),
        ({"phase": {**GRATING, "order": 0.5}}, "'order' must be a whole number"),
        ({"phase": {**RADIAL, "norm_radius": 0.0}}, "'norm_radius' must be positive"),
        ({"phase": {**GRATING, "efficiency": 1.5}}, "'efficiency' must be from 0 to 1"),
        ({"phase": 3}, "expected a mapping"),
        ({"type": "paraxial_lens"}, "needs 'power'"),
        ({"type": "paraxial_lens", "focal_length": 0.0}, "'focal_length' is 0"),
        ({"type": "paraxial_lens", "focal_length": 5.0, "power": 0.2}, "not both"),
        ({"type": "paraxial_lens", "power": 0.2, "phase": GRATING}, "cannot have a 'phase'"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_surface(row, wrong):
    with pytest.raises(InputError, match=rf"lens: surface 1: .*{wrong}"):
        lens_from_prescription(prescription({"type": "plane", **row}))


def test_a_lens_without_power_has_an_infinite_focal_length():
    lens = lens_from_prescription(prescription({"type": "paraxial_lens", "focal_length": math.inf}))
    assert prescription_of(lens)["surfaces"]["1"]["focal_length"] == math.inf
