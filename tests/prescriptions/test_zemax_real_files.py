"""What real files of Zemax say and what once was read otherwise; each case is a text of our own."""

import math

import pytest
import torch

from dolens import InputError, Rays
from dolens.prescriptions.zemax.reader import prescription_from_zemax, read_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.zemax_samples import lens_of, singlet, surface

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


def test_a_drawn_size_of_nothing_lets_light_pass(tmp_path):
    """Programs draw a plane that is only there to measure from with a semi-diameter of 1e-6."""
    text = HEAD + "".join(
        (
            surface(0, "DISZ INFINITY"),
            surface(1, "CURV 0", "DISZ 5", "DIAM 9.99999997E-7 1 0 0 1"),
            surface(2, "STOP", "CURV 0.02", "DISZ 4", f"GLAS ___BLANK 1 0 {INDEX} 0 0"),
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


def air(*lines):
    return singlet("CURV 0.02", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0", head=HEAD) + "".join(
        f"{line}\n" for line in ("MNUM 2 1", *lines)
    )


def test_a_gap_at_a_pressure_of_its_own_is_refused():
    own = ("PRES 0 1 0.0 0 0 0 1 1", 'GLSS 2 1 "" 0 0 0', "PRES 0 1 1.0 0 0 0", 'GLSS 1 1 ""')
    with pytest.raises(InputError, match="surface 2: a medium at a temp"):
        read_zemax(air(*own))


@pytest.mark.parametrize(
    "lines",
    [
        ("TEMP 0 1 20 0 0 0", "PRES 0 1 1 0 0 0", 'GLSS 1 1 "" 0 0'),
        ("PRES 0 2 0.5 0 0 0", 'GLSS 1 2 "" 0 0', 'GLSS 1 1 "" 0 0'),
        ("PRES 0 1 0.5 0 0 0", "THIC 1 1 4 0 0"),
        ("MNUM 2", "TEMP 0 1 50 0 0 0", "TEMP 0 2 20 0 0", 'GLSS 1 1 "A" 0 0', 'GLSS 1 2 "A" 0 0'),
    ],
    ids=["as the system", "of another configuration", "no glass behind it", "one as the system"],
)
def test_media_in_the_air_of_the_system_are_held(lines):
    assert len(read_zemax(air(*lines)).prescription["surfaces"]) == 2


def test_a_glass_that_schott_gave_up_stands_beside_schotts_own_both_ways():
    """Schott's SSK4 had the nd and Vd of Sumita's, which is read where GCAT names Schott first; and
    SK16 was made by both.
    """
    glasses = {1: "SSK4", 2: "SK16", 3: "F15", 4: "SK1"}
    head = "GCAT SCHOTT SUMITA\nENPD 4\n"
    rows = [surface(n, "DISZ 2", f"CURV 0.0{n}", f"GLAS {name}") for n, name in glasses.items()]
    rows[0] += "  STOP\n"
    text = head + surface(0, "DISZ INFINITY") + "".join(rows)
    text += surface(5, "CURV 0.01", "DISZ 9") + surface(6, "")
    found = prescription_from_zemax(text)
    named = [row["material"] for row in found["surfaces"].values()]
    assert named == ["SUMITA:SSK4", "SCHOTT:SK16", "SCHOTT:F15", "SCHOTT:SK1", "air"]
    assert prescription_from_zemax(zemax_of(found))["surfaces"] == found["surfaces"]


def test_a_jones_matrix_is_a_plane_that_is_said_to_polarize(tmp_path):
    jones = surface(1, "STOP", "TYPE JONESMAT", "PARM 1 1", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0")
    text = HEAD + surface(0, "DISZ INFINITY") + jones + surface(2, "CURV -0.05", "DISZ 39")
    found = read_zemax(text + surface(3, ""))
    assert "polarization: the Jones matrix of surface 1" in found.passed_over
    assert found.prescription["surfaces"]["1"]["type"] == "plane"
    assert float(lens_of(text + surface(3, ""), tmp_path).first_order(550.0).efl) == pytest.approx(
        40
    )


@pytest.mark.parametrize(("field", "held"), [("0 0", True), ("0 2", False)])
def test_a_curved_object_is_a_plane_to_fields_on_the_axis(field, held):
    head = f"ENPD 6\nFTYP 1 0 2 1\nYFLN {field}\n"
    text = singlet("CURV 0.02", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0", head=head)
    text = text.replace("DISZ INFINITY", "DISZ 90\n  CURV 0.1")
    if held:
        assert prescription_from_zemax(text)["object_distance"] == 90.0
    else:
        with pytest.raises(
            InputError, match=r"the object: a curved object \(radius 10 mm\) is not held"
        ):
            prescription_from_zemax(text)


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
