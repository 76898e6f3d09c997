"""Fields, weights, vignetting, pupils and stops of Zemax's files."""

import math

import pytest
import torch

from dolens import InputError, Rays
from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.zemax.samples import GLASS, lens_of, singlet, surface

GOOD = ("CURV 0.02", "DISZ 4", GLASS)


NEAR = {"object_distance": "90"}


EXACT = {"dtype": torch.float64}


INDEX, RADIUS, THICK = 1.5, 20.0, 5.0


HEAD = "ENPD 16\nFTYP 0 0 1 1\nYFLN 0\nWAVM 1 0.55 1\n"


# Light meets a sphere; the stop is the plane behind it.
BEHIND_A_SPHERE = "".join(
    (
        surface(0, "DISZ INFINITY"),
        surface(1, f"CURV {1 / RADIUS}", f"DISZ {THICK}", f"GLAS ___BLANK 1 0 {INDEX} 0 0"),
        surface(2, "STOP", "CURV 0", "DISZ 40"),
        surface(3, ""),
    )
)


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


def test_vignetting_factors_narrow_the_beam_of_their_field(tmp_path):
    head = "ENPD 6\nFTYP 0 0 2 1\nYFLN 0 5\nVCYN 0 0.5\n"
    lens = lens_of(singlet(*GOOD, head=head, last=""), tmp_path)
    spots = spot_diagram(lens, conditions(lens, lens.fields.points, [550.0]))
    light = (spots.valid * spots.weight).flatten(1).sum(1) / spots.weight.sum()
    assert float(light[0]) > 0.99
    assert float(light[1]) == pytest.approx(0.5, abs=0.05)


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


def height_behind_a_sphere(height):
    """Where a ray parallel to the axis crosses the stop, by the law of sines."""
    incidence = math.asin(height / RADIUS)
    slope = math.tan(incidence - math.asin(math.sin(incidence) / INDEX))
    sag = RADIUS - math.sqrt(RADIUS**2 - height**2)
    return height - slope * (THICK - sag)


@pytest.mark.parametrize("aiming", [0, 1, 2])
def test_the_stop_is_as_wide_as_the_aiming_of_the_file_makes_it(aiming, tmp_path):
    """Of a pupil of 16 mm the paraxial marginal ray fills the stop, and with real ray aiming the
    real one.
    """
    text = f"{HEAD}RAIM 0 {aiming} 1 1 0 0 0 0 0\n{BEHIND_A_SPHERE}"
    paraxial = 8.0 * (1.0 - THICK * (1.0 - 1.0 / INDEX) / RADIUS)
    expected = height_behind_a_sphere(8.0) if aiming == 2 else paraxial
    lens = lens_of(text, tmp_path)
    assert lens.surfaces["2"].semi_diameter == pytest.approx(expected, rel=1e-12)
    found = prescription_from_zemax(text)
    again = prescription_from_zemax(zemax_of(found))
    assert again.get("real_pupil", False) is (aiming == 2)


def test_the_real_marginal_ray_of_a_near_object(tmp_path):
    """It leaves the axis 60.1 mm before the sphere, for the rim of the paraxial pupil."""
    text = f"{HEAD.replace('16', '10')}RAIM 0 2 1\n{BEHIND_A_SPHERE}"
    lens = lens_of(text.replace("DISZ INFINITY", "DISZ 60.1"), tmp_path)
    pupil = lens.first_order(550.0).entrance_pupil
    slope = 5.0 / (60.1 + float(pupil.z))
    # y = slope (z + 60.1) on the sphere (z - R)² + y² = R².
    a, b, c = 1.0 + slope**2, 60.1 * slope**2 - RADIUS, (60.1 * slope) ** 2
    z = (-b - math.sqrt(b * b - a * c)) / a
    y = slope * (z + 60.1)
    normal = math.asin(y / RADIUS)
    refracted = math.asin(math.sin(normal + math.atan(slope)) / INDEX) - normal
    expected = y + math.tan(refracted) * (THICK - z)
    assert lens.surfaces["2"].semi_diameter == pytest.approx(expected, rel=1e-12)


def test_a_real_marginal_ray_that_is_lost_before_the_stop_is_refused(tmp_path):
    text = f"{HEAD.replace('16', '42')}RAIM 0 2 1\n{BEHIND_A_SPHERE}"
    with pytest.raises(InputError, match="real marginal ray"):
        lens_of(text, tmp_path)


def turned_stop(*stop, head=HEAD):
    """A cylinder behind a coordinate break that is the stop."""
    return head + "".join(
        (
            surface(0, "DISZ INFINITY"),
            surface(1, "STOP", "TYPE COORDBRK", *stop, "DISZ 2"),
            surface(2, "TYPE TOROIDAL", f"CURV {1 / RADIUS}", "PARM 1 1E20", "DISZ 5"),
            surface(3, ""),
        )
    )


def test_a_stop_on_a_break_about_the_axis_is_a_plane_there(tmp_path):
    """The pupil of 16 mm lies in the plane where the axes turn, 2 mm before the next surface."""
    lens = lens_of(turned_stop("PARM 5 45"), tmp_path)
    stop = lens.surfaces[str(lens.stop)]
    assert not stop.changes_axes and stop.semi_diameter == pytest.approx(8.0, rel=1e-15)
    z = [float(v) for v in lens.system().vertices]
    assert z[lens.stop - 1] == 0.0 and z[lens.stop] == 2.0
    pupil = lens.first_order(550.0).entrance_pupil
    assert float(pupil.z) == 0.0 and float(pupil.diameter) == pytest.approx(16.0, rel=1e-15)
    found = prescription_from_zemax(turned_stop("PARM 5 45"))
    assert prescription_from_zemax(zemax_of(found))["surfaces"] == found["surfaces"]


@pytest.mark.parametrize(
    "stop, head, said",
    [
        ("PARM 3 5", HEAD, "a stop on a coordinate break that decentres or tilts the axis"),
        ("PARM 2 1", HEAD, r"is not held \(decenter_y; allowed: a turn about z\)"),
        ("PARM 5 45", HEAD.replace("ENPD 16", "FLOA"), "the stop, a coordinate break, has no size"),
    ],
)
def test_other_stops_on_breaks_are_refused(stop, head, said, tmp_path):
    with pytest.raises(InputError, match=said):
        lens_of(turned_stop(stop, head=head), tmp_path)


def test_on_the_axis_a_telecentric_object_asks_nothing_of_the_stop(tmp_path):
    """The chief ray is the axis; the edge ray has the numerical aperture of the file.  Off the axis
    a stop that does not make chief rays parallel is refused.
    """
    system = "OBNA 0.1 0\nFTYP 1 1 1 1\nYFLN 0\nWAVM 1 0.55 1\n"
    text = system + BEHIND_A_SPHERE.replace("DISZ INFINITY", "DISZ 60")
    lens = lens_of(text, tmp_path)
    rays = lens.paraxial_rays(0.0, 550.0, 60.0)
    assert float(rays.marginal.slope_before[0]) == pytest.approx(
        math.tan(math.asin(0.1)), rel=1e-12
    )
    with pytest.raises(InputError, match="'telecentric_object'"):
        lens_of(text.replace("YFLN 0", "YFLN 1"), tmp_path)


def test_a_field_beyond_90_degrees_is_read_and_written(tmp_path):
    """Light of 100° meets a dome from the side, and the law of sines bends it there."""
    text = HEAD.replace("YFLN 0", "YFLN 100").replace("ENPD 16", "ENPD 1") + BEHIND_A_SPHERE
    lens = lens_of(text, tmp_path)
    assert lens.fields.points == ((0.0, 100.0),)
    again = prescription_from_zemax(zemax_of(prescription_from_zemax(text)))
    assert again["fields"]["angles"] == [[0.0, 100.0]]
    # It is met where the normal has turned by 70° from the axis, 30° from the ray.
    angle = math.radians(70.0)
    exact = {"dtype": torch.float64}
    point = RADIUS * torch.tensor([0.0, -math.sin(angle), 1.0 - math.cos(angle)], **exact)
    angle = math.radians(100.0)
    line = torch.tensor([0.0, math.sin(angle), math.cos(angle)], **exact)
    hit = lens.trace(Rays(point - 50.0 * line, line, 550.0), last=1)
    angle = math.radians(70.0) + math.asin(math.sin(math.radians(30.0)) / INDEX)
    expected = torch.tensor([0.0, math.sin(angle), math.cos(angle)], **exact)
    torch.testing.assert_close(hit.position, point, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(hit.direction, expected, rtol=0.0, atol=1e-14)
