"""Apertures and obscurations in Zemax's files."""

import pytest

from dolens import InputError
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_writer import zemax_of
from tests.prescriptions.zemax_samples import GLASS, singlet

APERTURES = {
    "rectangle": {"aperture": {"half_width_x": 5.0, "half_width_y": 4.0}},
    "ring": {"semi_diameter": 5.0, "obscuration": {"semi_diameter": 2.0}},
    "rectangular hole": {"semi_diameter": 5.0, "clips": False,
                         "obscuration": {"half_width_x": 1.0, "half_width_y": 2.0}},
    "ellipse": {"aperture": {"semi_axis_x": 5.0, "semi_axis_y": 4.0}},
    "ellipse off the axis": {"aperture": {"semi_axis_x": 5.0, "semi_axis_y": 4.0,
                                          "decenter_y": 3.0}},
    "circle off the axis": {"aperture": {"semi_diameter": 4.0, "decenter_x": -3.0}},
    "ring off the axis": {"aperture": {"semi_diameter": 4.0, "decenter_x": -3.0},
                          "obscuration": {"semi_diameter": 1.0}},
    "hole off the axis": {"semi_diameter": 5.0, "clips": False,
                          "obscuration": {"semi_diameter": 1.0, "decenter_x": 2.0}},
    "elliptical hole": {"semi_diameter": 5.0, "clips": False,
                        "obscuration": {"semi_axis_x": 1.0, "semi_axis_y": 2.0}},
    "no edge": {"semi_diameter": 5.0, "clips": False},
    "left to the fields": {"semi_diameter": "auto"},
}  # fmt: skip
WRITTEN = {
    "rectangle": "SQAP 5.0 4.0",
    "ring": "CLAP 2.0 5.0 0",
    "rectangular hole": "SQOB 1.0 2.0",
    "ellipse": "ELAP 5.0 4.0",
    "ellipse off the axis": "OBDC 0 3.0",
    "circle off the axis": "CLAP 0 4.0 0\n  OBDC -3.0 0",
    "ring off the axis": "CLAP 1.0 4.0 0\n  OBDC -3.0 0",
    "hole off the axis": "OBSC 0 1.0 0\n  OBDC 2.0 0",
    "elliptical hole": "ELOB 1.0 2.0",
    "no edge": "DIAM 5.0 1 0 0 1",
    "left to the fields": "DIAM 0 0 0 0 1",
}


@pytest.mark.parametrize("shape", APERTURES)
def test_apertures_of_every_shape_come_back(shape):
    first = {"radius": 30.0, "thickness": 3.0, "material": "1.5168/64.17"}
    last = {"radius": -30.0, "semi_diameter": 6.0, "material": "air"}
    lens = {"name": "Singlet", "sensor": {"distance": 25.0}, "stop": 2,
            "surfaces": {"1": first | APERTURES[shape], "2": last}}  # fmt: skip
    text = zemax_of(lens)
    assert WRITTEN[shape] in text
    row = prescription_from_zemax(text)["surfaces"]["1"]
    keys = ("semi_diameter", "clips", "aperture", "obscuration")
    assert {key: row[key] for key in keys if key in row} == APERTURES[shape]


def test_a_rectangle_with_a_hole_is_refused():
    row = APERTURES["rectangle"] | {"obscuration": {"semi_diameter": 1.0}}
    row |= {"radius": 30.0, "material": "1.5168/64.17"}
    with pytest.raises(InputError, match=r"surface 1: a \.zmx file cannot hold 'obscuration'"):
        zemax_of({"surfaces": {"1": row}, "sensor": {"distance": 25.0}})


def test_an_aperture_is_in_the_file_s_units():
    text = singlet("CURV 0.1", "DIAM 5", "SQAP 0.5 0.25", GLASS, head="UNIT IN\nFLOA\n")
    row = prescription_from_zemax(text)["surfaces"]["1"]
    assert row["aperture"] == {"half_width_x": 12.7, "half_width_y": 6.35}
