"""What of a surface light passes."""

import pytest
import torch

from dolens import InputError, Rays, Status
from dolens.prescriptions import lens_from_prescription, prescription_of

pytestmark = pytest.mark.usefixtures("backend")


def window(**aperture):
    """A plane that does nothing but clip."""
    return {
        "surfaces": {"1": {"type": "plane", "material": "air", **aperture}},
        "sensor": {"distance": 1.0},
    }


def passes(prescription, points):
    lens = lens_from_prescription(prescription)
    position = torch.tensor([[x, y, -1.0] for x, y in points], dtype=torch.float64)
    hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0]).double()))
    assert torch.equal(hit.valid, hit.status == Status.OK)
    assert set(hit.status.tolist()) <= {Status.OK, Status.VIGNETTED}
    return hit.valid.tolist()


def test_a_rectangle_passes_what_lies_strictly_inside_its_sides():
    rectangle = window(aperture={"half_width_x": 3.0, "half_width_y": 2.0})
    points = [(2.9, 1.9), (-2.9, -1.9), (3.0, 0.0), (0.0, 2.0), (3.1, 0.0), (0.0, -2.1)]
    assert passes(rectangle, points) == [True, True, False, False, False, False]


def test_an_obscuration_blocks_the_middle_and_its_own_edge():
    annulus = window(semi_diameter=5.0, obscuration={"semi_diameter": 2.0})
    points = [(0.0, 0.0), (0.0, 1.9), (2.0, 0.0), (0.0, 2.1), (4.9, 0.0), (5.0, 0.0)]
    assert passes(annulus, points) == [False, False, False, True, True, False]
    square = window(semi_diameter=5.0, obscuration={"half_width_x": 1.0, "half_width_y": 2.0})
    assert passes(square, [(0.9, 1.9), (1.1, 0.0), (0.0, 2.1)]) == [False, True, True]


def test_apertures_survive_writing_and_reading():
    written = window(
        aperture={"half_width_x": 3.0, "half_width_y": 2.0}, obscuration={"semi_diameter": 0.5}
    )
    row = prescription_of(lens_from_prescription(written))["surfaces"]["1"]
    assert row["aperture"] == written["surfaces"]["1"]["aperture"]
    assert row["obscuration"] == written["surfaces"]["1"]["obscuration"]
    assert "semi_diameter" not in row


@pytest.mark.parametrize(
    "aperture, message",
    [
        ({}, "surface 1: 'semi_diameter' is missing"),
        ({"semi_diameter": 1.0, "aperture": {"half_width_x": 1}}, "'half_width_y' is missing"),
        ({"semi_diameter": 1.0, "clips": 0}, "'clips' must be true or false, not 0"),
        ({"semi_diameter": "auto", "clips": True}, "an automatic semi-diameter clips nothing"),
        ({"clips": False, "aperture": {"semi_diameter": 1}}, "'aperture' clips"),
        ({"aperture": {"semi_diameter": 1, "semi_axis_x": 1}}, "give one of semi_diameter, half"),
        ({"aperture": {"semi_axis_x": 1.0}}, "'semi_axis_y' is missing"),
        ({"aperture": {"half_width_x": 1.0}}, "'half_width_y' is missing"),
        (
            {"aperture": {"half_width_x": 1.0, "half_width_y": -1.0}},
            "half_width_y must be positive",
        ),
        ({"aperture": {"width": 1.0}}, "unknown key 'width'"),
        ({"semi_diameter": 0.0}, "semi_diameter must be positive"),
        ({"semi_diameter": 1.0, "obscuration": {"semi_diameter": 2.0}}, "obscuration reaches 2 mm"),
    ],
)
def test_bad_apertures_are_one_clear_line(aperture, message):
    with pytest.raises(InputError, match=message):
        lens_from_prescription(window(**aperture))
