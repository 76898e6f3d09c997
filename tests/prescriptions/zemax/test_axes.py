"""Mirrors, coordinate breaks and tilts among a surface's properties (SCBD) in Zemax's files."""

import math

import pytest
import torch

from dolens import Rays
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.kernels.trace_cases import LENSES
from tests.prescriptions.zemax.samples import surface

F64 = torch.float64


HEAD = (
    "MODE SEQ\nUNIT MM\nENPD 20\nFTYP 0 0 1 1 0 0 0\nXFLN 0\nYFLN 0\nWAVM 1 0.5875618 1\nPWAV 1\n"
)


def broken(n, *parameters, gap=0, lines=()):
    numbered = (f"PARM {k} {p}" for k, p in enumerate(parameters, 1))
    return surface(n, "TYPE COORDBRK", *numbered, f"DISZ {gap}", *lines)


def image(n, *lines):
    return surface(n, "CURV 0", *lines, "DISZ 0")


def mirror(n, curvature, gap, *lines, size=50):
    return surface(n, f"CURV {curvature} 0 0 0 0", "GLAS MIRROR 0 0 1.5 40", f"DISZ {gap}",
                f"DIAM {size} 1 0 0 1", *lines)  # fmt: skip


OBJECT = surface(0, "CURV 0", "DISZ INFINITY")


def lens_of(text):
    return lens_from_prescription(prescription_from_zemax(text))


def axis(lens):
    """Where the ray along the axis lands."""
    ray = Rays(torch.tensor([0.0, 0.0, -1.0], dtype=F64), torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    return lens.trace(ray)


def test_the_sense_of_tilts_is_that_of_a_published_schiefspiegler():
    """Handbook of Optics, vol. II, ch. 18, no. 46, as Zemax has it: two mirrors tilted by -3.5° and
    -3.32° about x; the second tilt is undone, and the image is decentred by +24.0739 mm in y.
    """
    text = HEAD + OBJECT + surface(1, "CURV 0.0", "DISZ 160", "DIAM 20 1 0 0 1") + (
        broken(2, 0, 0, -3.5)
        + mirror(3, -1 / 1015, 0, "STOP", "CONI -4.278", size=10.02)
        + broken(4, 0, 0, -3.5, gap=-160.36)
        + broken(5, 0, 0, -3.32)
        + mirror(6, 1 / 1045.72, 0, size=9.65)
        + broken(7, 0, 0, 3.32, gap=206.8)
        + broken(8, 0, 24.0739)
        + image(9)
    )  # fmt: skip
    lens = lens_of(text)
    assert lens.stop == 3
    hit = axis(lens)
    assert bool(hit.valid)
    # 206.8·tan(2·3.32°) = 24.0739 to the digits that the file gives.
    assert abs(float(hit.position[1].detach())) < 6e-5
    assert abs(float(hit.position[0].detach())) < 1e-12


def test_the_order_flag_and_a_return_are_those_that_zemax_writes():
    """Turned by -45° about y at 50 mm from the axis and back: Zemax's own numbers for the return to
    surface 4 are a decenter of 14.6447, a tilt of 45 with the order flag, and a gap of -35.3553.
    """
    numbers = "14.644660940672615", "-0", "0", "44.999999999999993", "0", "1"
    text = HEAD + OBJECT + (
        surface(1, "STOP", "CURV 0", "DISZ 50", "DIAM 60 1 0 0 1")
        + broken(2, 0, 0, -45)
        + broken(3, -50)
        + broken(4, 0, 0, 0, -45)
        + broken(5, 50, 0, 0, 0, 0, 1)
        + surface(6, "CURV 0", "DISZ 0", "DIAM 90 1 0 0 1")
        + broken(7, *numbers, gap="-35.355339059327385", lines=("SCBD 3 3 4",))
        + surface(8, "CURV 0", "DISZ 0", "DIAM 90 1 0 0 1")
        + image(9)
    )  # fmt: skip
    places = lens_of(text).global_axes()
    before, after = places.origin[1], places.origin[-1]
    assert (after - before).abs().max() < 1e-13
    assert (places.rotation[-1] - places.rotation[1]).abs().max() < 1e-15


def test_a_fold_mirror_of_plus_45_degrees_sends_light_up():
    """As in a file that its author calls one mirror up, 45°."""
    text = HEAD + OBJECT + (
        surface(1, "STOP", "CURV 0.0", "DISZ 30", "DIAM 20 1 0 0 1")
        + broken(2, 0, 0, 45) + mirror(3, 0.0, 0) + broken(4, 0, 0, 45, gap=-20) + image(5)
    )  # fmt: skip
    lens = lens_of(text)
    place = lens.global_axes().origin[-1]
    assert torch.allclose(place, torch.tensor([0.0, 20.0, 30.0], dtype=F64), atol=1e-13)
    assert bool(axis(lens).valid)


def test_behind_a_mirror_is_the_medium_in_front_of_it():
    text = HEAD + OBJECT + (
        surface(1, "STOP", "CURV -0.005", "GLAS ___BLANK 1 0 1.5168 64.17", "DISZ 5", "DIAM 20 1")
        + mirror(2, -0.004, -5)
        + surface(3, "CURV -0.005", "DISZ -50", "DIAM 20 1 0 0 1")
        + mirror(4, 0.0, 20)
        + surface(5, "CURV 0.0", "DISZ 10", "DIAM 20 1 0 0 1")
        + image(6)
    )  # fmt: skip
    lens = lens_of(text)
    assert [m.name for m in lens.materials] == ["air", "1.5168/64.17/0", "mirror", "air", "mirror"]
    assert [m.name for m in lens.system().materials] == [
        "air", "1.5168/64.17/0", "1.5168/64.17/0", "air", "air",
    ]  # fmt: skip
    assert float(lens.sensor_distance.detach()) == 30.0


def test_lengths_of_a_break_have_the_files_unit_and_angles_have_not():
    text = HEAD.replace("UNIT MM", "UNIT CM") + OBJECT + (
        surface(1, "STOP", "CURV 0.0", "DISZ 3", "DIAM 2 1 0 0 1")
        + broken(2, 0.1, -0.2, 10, 20, 30, 1, gap=4) + mirror(3, -0.1, -1) + image(4)
    )  # fmt: skip
    row = prescription_from_zemax(text)["surfaces"]["2"]
    assert row == {
        "type": "coordinate_break", "decenter_x": 1.0, "decenter_y": -2.0, "tilt_x": 10.0,
        "tilt_y": 20.0, "tilt_z": 30.0, "order": "tilt_first", "thickness": 40.0,
    }  # fmt: skip


@pytest.mark.parametrize("name", ["mirrors", "folded"])
def test_a_folded_lens_is_written_and_read_back_to_the_last_bit(name):
    lens = LENSES[name](None)
    written = prescription_of(lens)
    written.pop("elements", None)
    written |= {"wavelengths": [587.5618], "fields": {"angles": [[0.0, 0.0]]}, "name": name}
    for row in written["surfaces"].values():
        if row["type"] == "xy_polynomial":
            row |= {"type": "conic", "radius": -90.0, "conic": -0.4}
            for key in [k for k in row if (k[0] in "xy" and k[-1].isdigit()) or k == "xy"]:
                del row[key]
    lens = lens_from_prescription(written)
    again = lens_from_prescription(prescription_from_zemax(zemax_of(prescription_of(lens))))
    assert prescription_of(again) == prescription_of(lens)
    assert again.system().senses == lens.system().senses


@pytest.mark.parametrize(
    "change, said",
    [
        (("STOP",), "surface 2: a stop on a coordinate break that decentres or tilts the axis"),
        (("GLAS ___BLANK 1 0 1.5 60",), "surface 2: a coordinate break with a medium"),
    ],
)
def test_what_no_break_can_be_is_refused(change, said):
    stop = () if change == ("STOP",) else ("STOP",)
    text = HEAD + OBJECT + (
        surface(1, *stop, "CURV 0.0", "DISZ 3", "DIAM 2 1 0 0 1")
        + broken(2, 0, 0, 10, gap=4, lines=change) + mirror(3, -0.001, -1) + image(4)
    )  # fmt: skip
    with pytest.raises(InputError, match=said):
        lens_of(text)


@pytest.mark.parametrize(
    "own, before, after",
    [
        # A fold mirror whose axes follow the light, as "Fold Mirror Using Surface Tilts" has it.
        (("SCBD 1 0 0 0 0 45 0 0", "SCBD 2 0 1 0 0 45 0 0"), (0, 0, 45), (0, 0, 45)),
        # What is undone behind the surface.
        (
            ("SCBD 1 0 0 1 -2 3 4 5", "SCBD 2 1 2 -1 2 -3 -4 -5"),
            (1, -2, 3, 4, 5, 0),
            (-1, 2, -3, -4, -5, 1),
        ),
        # What follows has other axes, or is undone in the order of the first.
        (
            ("SCBD 1 0 0 0.4 -0.3 6 -4 11", "SCBD 2 0 0 0.1 0.2 3 1 -2"),
            (0.4, -0.3, 6, -4, 11, 0),
            (0.1, 0.2, 3, 1, -2, 0),
        ),
        (
            ("SCBD 1 0 0 1 -2 3 4 5", "SCBD 2 0 5 -1 2 -3 -4 -5"),
            (1, -2, 3, 4, 5, 0),
            (-1, 2, -3, -4, -5, 0),
        ),
        # Tilts that stay.
        (("SCBD 1 1 0 0 0.5 -3 0 0",), (0, 0.5, -3, 0, 0, 1), None),
    ],
)
def test_a_surface_s_own_axes_are_breaks_around_it(own, before, after):
    """Zemax's manual: as a coordinate break, the surface, and another coordinate break."""
    gap = 0 if after else -40
    around = broken(2, *before) + mirror(3, -0.01, gap, "STOP")
    if after:
        around += broken(4, *after, gap=-40)
    last = 5 if after else 4
    plane = surface(1, "CURV 0.001 0 0 0 0", "DISZ 30", "DIAM 30 1 0 0 1", "GLAS N-BK7 0 0 1.5 40")
    expected = prescription_from_zemax(HEAD + OBJECT + plane + around + image(last))
    found = prescription_from_zemax(
        HEAD + OBJECT + plane + mirror(2, -0.01, -40, "STOP", *own) + image(3)
    )
    assert found["stop"] == expected["stop"] == 3
    rows = [prescription_of(lens_from_prescription(p))["surfaces"] for p in (found, expected)]
    assert rows[0] == rows[1]
    assert found["sensor"] == expected["sensor"]


def test_the_image_may_have_axes_of_its_own():
    plane = surface(1, "STOP", "CURV 0", "DISZ 3", "DIAM 2 1 0 0 1")
    axes = lens_of(HEAD + OBJECT + plane + image(2, "SCBD 1 0 0 0 0 7 0 0")).global_axes()
    assert float(axes.rotation[-1, 2, 2].detach()) == pytest.approx(math.cos(math.radians(7.0)))


def test_decenters_of_a_surface_s_own_are_in_the_file_s_units():
    text = (HEAD + OBJECT).replace("UNIT MM", "UNIT IN")
    plane = surface(1, "CURV 0.01 0 0 0 0", "DISZ 1", "DIAM 1 1 0 0 1", "GLAS N-BK7 0 0 1.5 40")
    own = mirror(2, -0.01, -4, "STOP", "SCBD 1 0 0 0.5 0 0 0 0")
    row = prescription_from_zemax(text + plane + own + image(3))["surfaces"]["2"]
    assert row == {"type": "coordinate_break", "decenter_x": 12.7, "thickness": 0.0}
