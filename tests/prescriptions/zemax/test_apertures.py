"""Apertures and obscurations in Zemax's files."""

import pytest
import torch

from dolens import InputError, Rays
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.zemax.samples import GLASS, lens_of, singlet, surface

FRONT = ("CURV 0.02", "DISZ 4", GLASS)
HEAD = "ENPD 16\nFTYP 0 0 1 1\nYFLN 0\nWAVM 1 0.55 1\n"


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
    "blocking ring": {"semi_diameter": 5.0, "clips": False,
                      "obscuration": {"inner_semi_diameter": 1.5, "semi_diameter": 2.0}},
    "spider": {"semi_diameter": 5.0, "clips": False,
               "obscuration": {"width": 0.5, "arms": 3, "decenter_y": 1.0}},
    "drawn by hand": {"aperture": {"polygons": [[[-4.0, -3.0], [4.0, -3.0], [0.0, 0.1]]],
                                   "decenter_x": 0.5}},
    "two drawn by hand": {"semi_diameter": 5.0, "clips": False,
                          "obscuration": {"polygons": [[[-4.0, -3.0], [-3.0, -3.0], [-3.5, 4.0]],
                                                       [[3.0, -3.0], [4.0, -3.0], [3.5, 4.0]]]}},
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
    "blocking ring": "OBSC 1.5 2.0 0",
    "spider": "SPID 0.5 3.0 0\n  OBDC 0 1.0",
    "drawn by hand": "UDAD 1 -4.0 -3.0 0",
    "two drawn by hand": "UDAD 4 0 0 0\n  UDAD 5 3.0 -3.0 0",
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


def with_aperture(*lines, head="UNIT MM\nFLOA\n"):
    """The row of the first surface of a singlet with lines of an aperture."""
    text = singlet("CURV 0.01", "DIAM 5 1", *lines, GLASS, head=head)
    return prescription_from_zemax(text)["surfaces"]["1"]


def test_outlines_drawn_by_a_user_end_at_0_0_and_are_in_the_file_s_units():
    """As `sc_slit.ZMX` of Zemax's short course has them: slits, one after the other."""
    corners = ["-5 -6", "-5 6", "-4 6", "-4 -6", "0 0", "-3 -6", "-3 6", "-2 6", "-2 -6", "0 0"]
    lines = [f"UDAD {n} {xy} 0.0" for n, xy in enumerate(corners, 1)]
    row = with_aperture("USAP 0 0 0", 'UDAD 0 "SLITS.UDA" 1.0', *lines, head="UNIT CM\nFLOA\n")
    first = [[-50.0, -60.0], [-50.0, 60.0], [-40.0, 60.0], [-40.0, -60.0]]
    second = [[-30.0, -60.0], [-30.0, 60.0], [-20.0, 60.0], [-20.0, -60.0]]
    assert row["aperture"] == {"polygons": [first, second]}


def test_a_floating_aperture_with_a_hole_is_a_ring_of_the_semi_diameter():
    row = with_aperture("FLAP 2 7 0")
    assert row["semi_diameter"] == 5.0
    assert row["obscuration"] == {"semi_diameter": 2.0}


def test_a_circle_of_1e10_has_no_edge_but_its_hole():
    """As the primary mirror of Zemax's own Schmidt-Cassegrain sample has it."""
    text = singlet("CURV 0.01", "DIAM 5", GLASS, last="DIAM 6 0\n  CLAP 2 1.0E+10 0")
    row = prescription_from_zemax(text)["surfaces"]["2"]
    assert (row["semi_diameter"], row["clips"]) == (6.0, False)
    assert row["obscuration"] == {"semi_diameter": 2.0}


@pytest.mark.parametrize(
    "lines, message",
    [
        (["USAP 0 0 0", 'UDAD 0 "MY OWN.UDA" 1.0'], "stands in MY OWN.UDA, not here"),
        (["USAP 0 0 0", "UDAD 1 1 1 0", "UDAD 2 2 1 90", "UDAD 3 2 2 0"], "with arcs"),
        (["USAP 0 0 0", "UDAD 0 A.UDA 2.0", "UDAD 1 1 1 0"], "another scale"),
        (["USAP 0 0 0", "UDAD 1 1 1 0", "UDAD 2 2 1 0"], "three corners"),
        (
            [
                "USOB 0 0 0",
                *(f"UDAD {n} {xy} 0" for n, xy in enumerate(["-4 -4", "4 -4", "1 4", "0 0"], 1)),
                *(f"UDAD {n} {xy} 0" for n, xy in enumerate(["-1 -1", "1 -1", "1 1"], 5)),
            ],
            "outlines that lie in one another",
        ),
        (["SPID 0.5 2.5 0"], "number of arms must be whole"),
    ],
)
def test_outlines_that_are_not_held_say_why(lines, message):
    with pytest.raises(InputError, match=message):
        with_aperture(*lines)


def test_a_rectangular_stop_takes_light_from_the_pupil(tmp_path):
    lens = lens_of(singlet(*FRONT, "SQAP 9 1", head="ENPD 6\n"), tmp_path)
    aperture = lens.surfaces["1"].aperture
    assert (aperture.edge.semi_diameter, aperture.window.half_width_y) == (pytest.approx(3.0), 1.0)
    points = torch.tensor([[2.9, 0.0], [3.1, 0.0], [0.0, 0.9], [0.0, 1.1]], dtype=torch.float64)
    assert (aperture.margin(*points.T) > 0.0).tolist() == [True, False, True, False]
    position = torch.cat([points, torch.zeros(4, 1, dtype=torch.float64)], 1)
    for backend in ("reference", "cpu"):
        lens.backend = backend
        hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 550.0))
        assert hit.valid.tolist() == [True, False, True, False]


def test_an_ellipse_beside_the_vertex(tmp_path):
    """((x - 1)/2)² + ((y - 3)/1)² < 1."""
    lens = lens_of(singlet(*FRONT, last="ELAP 2 1 0\n  OBDC 1 3", head="ENPD 20\n"), tmp_path)
    lens.surfaces["1"].aperture = lens.surfaces["1"].aperture.opened()
    points = torch.tensor([[1.0, 3.9], [1.0, 4.1], [2.9, 3.0], [3.1, 3.0], [0.0, 0.0]]).double()
    inside = lens.surfaces["2"].aperture.margin(*points.T) > 0.0
    assert inside.tolist() == [True, False, True, False, False]
    position = torch.cat([points, torch.zeros(5, 1).double()], 1)
    rays = Rays(position, torch.tensor([0.0, 0.0, 1.0]).double(), 550.0)
    passing = []
    for backend in ("reference", "cpu"):
        lens.backend = backend
        passing.append(lens.trace(rays).valid.tolist())
    assert passing[0] == passing[1]
    assert passing[0][4] is False


def test_a_drawn_size_of_nothing_lets_light_pass(tmp_path):
    """Programs draw a plane that is only there to measure from with a semi-diameter of 1e-6."""
    text = HEAD + "".join(
        (
            surface(0, "DISZ INFINITY"),
            surface(1, "CURV 0", "DISZ 5", "DIAM 9.99999997E-7 1 0 0 1"),
            surface(2, "STOP", "CURV 0.02", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0"),
            surface(3, "CURV -0.02", "DISZ 40", "DIAM 1E-6 1 0 0 1", "OBSC 0 1 0"),
            surface(4, ""),
        )
    )
    lens = lens_of(text, tmp_path)
    start = torch.tensor([[0.0, 7.9, -9.0], [0.0, 0.5, -9.0]], dtype=torch.float64)
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(2, 3)
    for backend in ("reference", "cpu"):
        lens.backend = backend
        assert lens.trace(Rays(start, ahead, 550.0)).valid.tolist() == [True, False]
