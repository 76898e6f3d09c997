"""Fields, weights, vignetting, pupils and air of Zemax's files."""

import math

import pytest
import torch

from dolens import Rays
from dolens.analysis.spot_diagram import spot_diagram
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.zemax_samples import GLASS, lens_of, singlet

GOOD = ("CURV 0.02", "DISZ 4", GLASS)
NEAR = {"object_distance": "90"}


def landed(lens, field):
    chief = lens.chief_ray(field, lens.primary_wavelength, lens.object_distance)
    hit = lens.trace(Rays(chief.position, chief.direction, lens.primary_wavelength))
    return hit.position[..., :2]


def test_weights_and_vignetting_factors_are_held_and_written():
    head = (
        "ENPD 6\nFTYP 0 0 3 2\nXFLN 0 0 0\nYFLN 0 3 5\nFWGN 1 2 0.5\nVDXN 0 0 0\n"
        "VDYN 0 0 -0.05\nVCXN 0 0.1 0.2\nVCYN 0 0.2 0.3\nVANN 0 0 10\n"
        "WAVM 1 0.5 1\nWAVM 2 0.6 3\nPWAV 2\n"
    )
    found = prescription_from_zemax(singlet(*GOOD, head=head))
    assert found["wavelength_weights"] == [1.0, 3.0]
    assert found["fields"]["weights"] == [1.0, 2.0, 0.5]
    assert found["fields"]["vignetting"] == [
        {},
        {"compression_x": 0.1, "compression_y": 0.2},
        {"decenter_y": -0.05, "compression_x": 0.2, "compression_y": 0.3, "angle": 10.0},
    ]
    again = prescription_from_zemax(zemax_of(found))
    assert {key: again[key] for key in found} == found


def test_more_than_twelve_fields_have_a_line_each():
    listed = " ".join(map(str, range(12)))
    head = f"ENPD 3\nFTYP 0 0 14 1\nYFLN {listed}\nFENF 14 14\nFEFD 0 12.5 2 0 0 0 0 0\nFEFD 1 13\n"
    found = prescription_from_zemax(singlet(*GOOD, head=head))["fields"]
    assert found["angles"][-3:] == [[0.0, 11.0], [0.0, 12.5], [1.0, 13.0]]
    assert found["weights"][-2:] == [2.0, 1.0]


def test_older_lists_of_wavelengths_and_weights():
    head = "ENPD 3\nFTYP 0 0 2 2\nYFLD 0 5\nFWGT 1 3\nWAVL 0.5 0.6\nWWGT 1 4\n"
    found = prescription_from_zemax(singlet(*GOOD, head=head))
    assert (found["wavelengths"], found["wavelength_weights"]) == ([500.0, 600.0], [1.0, 4.0])
    assert found["fields"] == {"angles": [[0.0, 0.0], [0.0, 5.0]], "weights": [1.0, 3.0]}


@pytest.mark.parametrize("near", [{}, NEAR], ids=["infinite", "finite"])
def test_chief_rays_land_at_real_image_heights(near, tmp_path):
    lens = lens_of(
        singlet(*GOOD, head="ENPD 4\nFTYP 3 0 2 1\nXFLN 0 1\nYFLN -6 2\n", **near), tmp_path
    )
    fields = torch.tensor(lens.fields.points, dtype=torch.float64)
    wanted = torch.tensor([[0.0, -6.0], [1.0, 2.0]], dtype=torch.float64)
    assert (landed(lens, fields) - wanted).abs().max() < 1e-9


def test_paraxial_image_heights(tmp_path):
    """h' = f·tan(field) of an object at infinity, and the magnification times the height."""
    head = "ENPD 4\nFTYP 2 0 1 1\nYFLN 3\n"
    lens = lens_of(singlet(*GOOD, head=head), tmp_path)
    ((_, angle),) = lens.fields.points
    assert math.tan(math.radians(angle)) * float(lens.first_order().efl) == pytest.approx(3.0)
    lens = lens_of(singlet(*GOOD, head=head, **NEAR), tmp_path)
    ((_, height),) = lens.fields.points
    assert height * float(lens.first_order(587.5618, 90.0).magnification) == pytest.approx(3.0)


def test_angles_to_a_finite_object_are_those_at_the_entrance_pupil(tmp_path):
    text = singlet(*GOOD, head="ENPD 4\nFTYP 0 0 1 1\nYFLN 10\n", **NEAR)
    text = text.replace("  STOP\n", "").replace("SURF 2\n", "SURF 2\n  STOP\n")
    lens = lens_of(text, tmp_path)
    pupil = float(lens.first_order().entrance_pupil.z)
    assert pupil != 0.0
    ((_, height),) = lens.fields.points
    assert height == pytest.approx(-math.tan(math.radians(10.0)) * (90.0 + pupil), rel=1e-12)


def test_a_numerical_aperture_and_a_cone_angle(tmp_path):
    """The paraxial marginal ray leaves the object under the angle whose sine is the aperture."""
    for head in ("OBNA 0.04 0\n", f"OBNA {math.degrees(math.asin(0.04))!r} 1\n"):
        lens = lens_of(singlet(*GOOD, head=head, **NEAR), tmp_path)
        slope = math.tan(math.asin(0.04))
        assert lens.surfaces["1"].semi_diameter == pytest.approx(90.0 * slope, rel=1e-12)


def test_a_working_f_number(tmp_path):
    lens = lens_of(singlet(*GOOD, head="FNUM 12 1\n", **NEAR), tmp_path)
    assert float(lens.first_order(587.5618, 90.0).working_f_number) == pytest.approx(12.0)


def test_air_is_held_where_indices_follow_it():
    held = prescription_from_zemax(singlet(*GOOD, head="ENPD 3\nENVD 35 0.5 1\n"))
    assert (held["temperature"], held["pressure"]) == (35.0, 0.5)
    assert prescription_from_zemax(zemax_of(held))["temperature"] == 35.0
    catalogue = prescription_from_zemax(singlet(*GOOD, head="ENPD 3\nENVD 35 0.5 0\n"))
    assert not {"temperature", "pressure"} & catalogue.keys()


def test_a_size_that_is_left_to_the_fields_passes_all_their_light(tmp_path):
    head = "ENPD 6\nFTYP 0 0 2 1\nYFLN 0 10\n"
    lens = lens_of(singlet(*GOOD, head=head, last=""), tmp_path)
    edge = lens.surfaces["2"].aperture
    assert not edge.clips
    rays = lens.marginal_rays((0.0, 10.0))
    heights = lens.trace(rays, record=True).points[1][:, :2].norm(dim=-1)
    assert edge.semi_diameter == pytest.approx(float(heights.max()), rel=5e-3)


def test_a_diameter_that_is_drawn_clips_nothing(tmp_path):
    head = "ENPD 6\nFTYP 0 0 1 1\nYFLN 10\n"
    near_the_rim = [[0.0, 0.9], [0.0, -0.9], [0.9, 0.0]]
    lens = lens_of(singlet(*GOOD, head=head, last="DIAM 0.1 1"), tmp_path)
    assert bool(lens.trace(lens.aim((0.0, 10.0), near_the_rim)).valid.all())
    clipped = lens_of(singlet(*GOOD, head=head, last="DIAM 0.1 1\n  FLAP 0 0.1 0"), tmp_path)
    assert not bool(clipped.trace(clipped.aim((0.0, 10.0), near_the_rim)).valid.any())


def test_a_rectangular_stop_takes_light_from_the_pupil(tmp_path):
    lens = lens_of(singlet(*GOOD, "SQAP 9 1", head="ENPD 6\n"), tmp_path)
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
    lens = lens_of(singlet(*GOOD, last="ELAP 2 1 0\n  OBDC 1 3", head="ENPD 20\n"), tmp_path)
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


def test_vignetting_factors_narrow_the_beam_of_their_field(tmp_path):
    head = "ENPD 6\nFTYP 0 0 2 1\nYFLN 0 5\nVCYN 0 0.5\n"
    lens = lens_of(singlet(*GOOD, head=head, last=""), tmp_path)
    spots = spot_diagram(lens, lens.fields.points, [550.0])
    light = (spots.valid * spots.weight).flatten(1).sum(1) / spots.weight.sum()
    assert float(light[0]) > 0.99
    assert float(light[1]) == pytest.approx(0.5, abs=0.05)
