"""Off-axis, dispersing and unusual systems do what their sources, and closed forms, say of them."""

import math

import pytest
import torch

from dolens import Rays, Status
from dolens.optics.ray_tracing import trace_rays
from dolens.prescriptions import lens_from_prescription, load_prescription

AZIMUTHS = torch.arange(16, dtype=torch.float64) * (math.pi / 8)
RIM = 0.9999 * torch.stack((AZIMUTHS.cos(), AZIMUTHS.sin()), -1)


def prescription_of(name, **rows):
    """A prescription whose automatic semi-diameters, which clip nothing, are not searched for;
    `rows` replaces keys of single surfaces."""
    found = load_prescription(f"published/{name}")
    surfaces = {str(n): dict(row) for n, row in found["surfaces"].items()}
    for n, row in surfaces.items():
        row |= rows.get(f"surface_{n}", {})
        if row.get("semi_diameter") == "auto" and n != str(found["stop"]):
            row |= {"semi_diameter": 1e3, "clips": False}
    return found | {"surfaces": surfaces}


def built(name, **rows):
    return lens_from_prescription(prescription_of(name, **rows), where=name)


def image(lens, point, wavelength=None, pupil=RIM):
    """Image of a field point by rays through the stop, the chief ray first; all of them arrive."""
    wavelength = wavelength or lens.primary_wavelength
    pupil = torch.cat((torch.zeros(1, 2, dtype=torch.float64), pupil))
    fields = torch.tensor(point, dtype=torch.float64).expand_as(pupil)
    with torch.no_grad():
        aimed = lens.aim(fields, pupil, wavelength, lens.object_distance)
        hit = lens.trace(Rays(aimed.position, aimed.direction, wavelength))
    assert hit.status.tolist() == [int(Status.OK)] * len(pupil)
    return hit


def rms_radius(hit):
    spread = hit.position[1:, :2] - hit.position[1:, :2].mean(0)
    return float(spread.square().sum(-1).mean().sqrt())


def airy_radius(wavelength, f_number):
    return 1.22 * wavelength * 1e-6 * f_number


# Offner relay


def test_the_ring_of_the_offner_relay_is_where_a_chief_ray_meets_the_middle_of_the_convex_mirror():
    surfaces = prescription_of("offner_us3748015")["surfaces"]
    concave, convex = (abs(surfaces[n]["radius"]) for n in ("1", "2"))
    # Parallel light at height h crosses the axis R/(2 cos θ) from the centre, sin θ = h/R.
    assert convex == pytest.approx(concave / (2 * math.cos(math.asin(36 / concave))), abs=0.005)


@pytest.mark.parametrize("azimuth", [0.0, 0.7, 1.5])
def test_the_offner_relay_images_its_ring_one_to_one(azimuth):
    lens = built("offner_us3748015")
    point = (36 * math.sin(azimuth), 36 * math.cos(azimuth))
    hit = image(lens, point)
    assert hit.position[0, :2].tolist() == pytest.approx([-x for x in point], abs=1e-5)
    # Sharp on the ring, and less so 2 mm beside it.
    ring = rms_radius(hit)
    assert ring < 0.01 * airy_radius(588, 10) < rms_radius(image(lens, (0.0, 38.0)))


# Spectrometers


@pytest.mark.parametrize(
    ("name", "wavelength", "numerical_aperture", "radius"),
    [
        # Semi-diameters of the images that the source's files give, by OpticStudio.
        ("spectrometer_czerny_turner", 450, 0.05, 14.03854250926),
        ("spectrometer_toroidal_grating", 450, 0.05, 20.66772084056),
    ],
)
def test_a_cone_from_the_slit_reaches_as_far_as_in_opticstudio(
    name, wavelength, numerical_aperture, radius
):
    lens = built(name)
    across = numerical_aperture * torch.stack((AZIMUTHS.cos(), AZIMUTHS.sin()), -1)
    along = torch.full((len(across), 1), math.sqrt(1 - numerical_aperture**2), dtype=torch.float64)
    start = torch.tensor([0.0, 0.0, -float(lens.object_distance)], dtype=torch.float64)
    rays = Rays(start.expand(len(across), 3), torch.cat((across, along), -1), wavelength)
    # The stop's semi-diameter is that of paraxial rays, so that the cone's rim is outside it.
    with torch.no_grad():
        hit = trace_rays(lens.system().opened(), rays)
    assert float(hit.position[:, :2].norm(dim=-1).max()) == pytest.approx(radius, rel=1e-6)


def test_the_dyson_spectrum_is_ten_millimetres_long_and_the_slit_is_imaged_one_to_one():
    lens = built("spectrometer_dyson_montero_orille")
    slit = {wave: image(lens, (4.0, 0.0), wave) for wave in lens.wavelengths}
    ends = [float(slit[wave].position[0, 1]) for wave in (400.0, 1700.0)]
    assert ends[1] - ends[0] == pytest.approx(10.0, abs=0.05)
    for hit in slit.values():
        assert float(hit.position[0, 0]) == pytest.approx(-4.0, abs=1e-3)
        assert rms_radius(hit) < 1e-3
    # 12.99385727 mm is the image's semi-diameter that the source's file gives, by OpticStudio.
    tip = image(lens, (0.0, 0.0), 1700.0).position[:, :2].norm(dim=-1).max()
    assert float(tip) == pytest.approx(12.99385727, abs=1e-4)


def test_the_prism_turns_each_wavelength_by_snells_law_and_the_camera_images_the_angle():
    lens = built("spectrometer_prism")
    glass = lens.materials[3]
    apex, incidence = math.radians(32), math.radians(16)

    def emergence(wave):
        n = float(glass.index(wave))
        return math.asin(n * math.sin(apex - math.asin(math.sin(incidence) / n)))

    turn = prescription_of("spectrometer_prism")["surfaces"]["6"]["tilt_x"]
    assert math.degrees(emergence(550.0)) == pytest.approx(turn, abs=1e-6)
    heights = {}
    for wave in (450.0, 550.0, 650.0):
        hit = image(lens, (0.0, 0.0), wave)
        heights[wave] = float(hit.position[0, 1])
        expected = -100 * math.tan(emergence(wave) - emergence(550.0))
        # 100 f tan of the angle from 550 nm, for every ray of the parallel light.
        assert heights[wave] == pytest.approx(expected, abs=1e-6)
        assert rms_radius(hit) < 1e-9
    assert heights[650.0] - heights[450.0] == pytest.approx(5.4, abs=0.05)


# Unobscured mirrors


def test_an_off_axis_paraboloid_is_stigmatic_and_its_focus_lies_where_the_parabola_says():
    lens = built("paraboloid_off_axis_100")
    hit = image(lens, (0.0, 0.0))
    assert float(hit.position[:, :2].abs().max()) < 1e-12
    axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    with torch.no_grad():
        middle = lens.trace(Rays(-axis, axis, 587), record=True).points[-1, 0]
    # In the lens's axes the parent's axis lies 36 mm above, and its focus 100 mm in front.
    focus = torch.tensor([0.0, 36.0, 120.0 - 100.0], dtype=torch.float64)
    assert float((middle - focus).norm()) == pytest.approx(100 + 36**2 / 400, abs=1e-9)


def test_the_tilts_of_the_schiefspiegler_leave_less_than_the_airy_disc():
    assert rms_radius(image(built("schiefspiegler_platt_318"), (0, 0))) < airy_radius(587.6, 20.1)
    # The tilt of the third mirror corrects the astigmatism of the others.
    straight = built(
        "schiefspiegler_platt_318", surface_7={"tilt_x": 0.0}, surface_9={"tilt_x": 0.0}
    )
    assert rms_radius(image(straight, (0, 0))) > 3 * airy_radius(587.6, 20.1)


def test_the_toroid_of_the_yolo_corrects_its_astigmatism():
    lens = built("yolo_hoo_v2c18_46")
    assert rms_radius(image(lens, (0.0, 0.0))) < 0.3 * airy_radius(550, 15.2)
    sphere = built("yolo_hoo_v2c18_46", surface_6={"radius_x": 1045.72})
    assert rms_radius(image(sphere, (0.0, 0.0))) > airy_radius(550, 15.2)
    # The image's semi-diameter that the file gives, by OpticStudio.
    edge = image(lens, (1.0, 0.0)).position[:, :2].norm(dim=-1).max()
    assert float(edge) == pytest.approx(5.3137812819569294, abs=2e-4)


# Aspheres


def test_the_q_asphere_has_the_numerical_aperture_of_its_catalogue_and_a_point_for_an_image():
    lens = built("asphere_q_thorlabs_asl5040")
    hit = image(lens, (0.0, 0.0))
    sine = hit.direction[1:, :2].norm(dim=-1)
    assert sine.tolist() == pytest.approx([0.65] * len(sine), abs=0.005)
    assert rms_radius(hit) < airy_radius(405, 0.5 / 0.65)
    without = built("asphere_q_thorlabs_asl5040", surface_1={"q0": 0.0})
    assert rms_radius(image(without, (0.0, 0.0))) > 100 * airy_radius(405, 0.5 / 0.65)


def test_the_axicon_focuses_into_a_ring():
    hit = image(built("axicon_ring_focus"), (0.0, 0.0), pupil=RIM)
    radii = hit.position[1:, :2].norm(dim=-1).tolist()
    # A cone of slope a turns light by (n - 1)·a, and f = R/(n - 1): the ring's radius is R·a.
    assert radii == pytest.approx([40 * 0.01] * len(radii), rel=0.005)
    # The image's semi-diameter that the file gives, by OpticStudio.
    assert radii == pytest.approx([0.4010458306812] * len(radii), rel=2e-6)


# Real rays that CODE V's listing prints: field (degrees), y 300 mm in front of the lens, and y on
# the image, mm, of the chief ray and of the rays at ±50 mm from it.
CODE_V = (
    (2.0, 112.848743, 14.075077, {50: 0.000408, -50: 0.001669}),
    (0.0, 144.927530, 0.0, {50: 0.004296, -50: -0.000681}),
    (-2.0, 177.959658, -14.309040, {50: 0.002791, -50: -0.001003}),
)


@pytest.mark.parametrize(
    ("name", "tolerance"),
    # The listing's focal distance has four decimals, and the coefficients of Q five digits.
    [("three_mirror_compact", 1e-5), ("three_mirror_compact_q", 5e-4)],
)
@pytest.mark.parametrize(("field", "start", "end", "aberrations"), CODE_V)
def test_rays_of_the_three_mirror_compact_are_those_of_code_v(
    name, tolerance, field, start, end, aberrations
):
    lens = built(name)
    y = torch.tensor([start, *(start + height for height in aberrations)], dtype=torch.float64)
    position = torch.stack((torch.zeros_like(y), y, torch.full_like(y, -300.0)), -1)
    angle = math.radians(field)
    direction = torch.tensor([0.0, math.sin(angle), math.cos(angle)], dtype=torch.float64)
    with torch.no_grad():
        # The outermost rays pass the edge of the stop, which is that of paraxial rays.
        hit = trace_rays(lens.system().opened(), Rays(position, direction.expand_as(position), 500))
    expected = [end, *(end + error for error in aberrations.values())]
    assert hit.position[:, 1].tolist() == pytest.approx(expected, abs=tolerance)
