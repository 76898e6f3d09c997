"""What a designer looks at, measured along a curved sensor.

A spherical mirror with its stop at the centre of curvature turns with its field: on a sphere about
that centre, all that belongs to a field is the same function of the height in the beam, whatever
the field.  The closed form is elementary trigonometry.
"""

import dataclasses
import math

import pytest
import torch

from dolens import InputError
from dolens.alignment.pose import Pose
from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.field_curves import field_curves
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.analysis.ray_intercepts import ray_fans
from dolens.analysis.spot_diagram import spot_diagram
from dolens.diffraction.entrance_beam import find_beam
from dolens.diffraction.field_wavefronts import field_wavefronts, object_points
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.optimize.image_quality import WavefrontResiduals
from dolens.optimize.merit import MeritFunction
from dolens.optimize.operands import LensProperties, operand
from dolens.optimize.ray_intercept_quality import RayInterceptResiduals
from dolens.optimize.variables import DesignVariables
from dolens.plotting.section import sensor_curve
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from dolens.tolerancing.sensitivity import linear_spots
from tests.optics.test_curved_sensor import mirror

# Of the sensor about the centre: a little more than the focal length, so that spots have a size.
RADIUS, WAVE, STOP = 100.1, 550.0, 10.0
FIELDS = [(0.0, 0.0), (0.0, 15.0), (0.0, 40.0), (0.0, -30.0)]
ANGLES = torch.deg2rad(torch.tensor([y for _, y in FIELDS], dtype=torch.float64))


@pytest.fixture
def lens():
    """Its sensor about the centre of curvature."""
    return mirror(
        sensor={"distance": RADIUS - 200.0, "radius": -RADIUS},
        stop_size=STOP,
        wavelengths=[WAVE],
        fields={"angles": FIELDS},
    )


def off_the_chief_ray(heights):
    """How far along the sensor's tangent plane (mm) rays of these heights in their beam land.

    A ray at height h meets the mirror at the angle i, sin i = h/R, and comes back under 2i towards
    the point R/(2·cos i) from the centre on the middle of its beam.  Before that it meets the
    sphere, seen from the centre 2i - β off the middle, with sin β = R·sin(2i)/(2·cos i·r).
    """
    i = torch.asin(heights / 200.0)
    beta = torch.asin(100.0 / torch.cos(i) * torch.sin(2.0 * i) / RADIUS)
    return RADIUS * torch.sin(2.0 * i - beta)


def test_a_fan_lands_where_trigonometry_says_at_every_field(lens):
    """A flat stop is seen foreshortened in the y-z plane, and in full across it."""
    fans = ray_fans(lens, conditions(lens, FIELDS[:3], [WAVE]), 9)
    heights = STOP * fans.coordinate
    across = 1e3 * off_the_chief_ray(heights)
    assert across.abs().max() > 2.0
    # The rim is aimed at a little inside.
    for field, angle in enumerate(ANGLES[:3]):
        along = 1e3 * off_the_chief_ray(heights * math.cos(angle))
        size = torch.maximum(along.abs(), across.abs()).max()
        for found, expected in (
            (fans.sagittal_um[field, 0], across),
            (fans.tangential_um[field, 0], along),
        ):
            ok = ~found.isnan()
            assert ok[1:-1].all()
            assert (found - expected)[ok].abs()[1:-1].max() < 1e-7 * size


def test_foci_lie_on_their_own_sphere(lens):
    """Both foci of a thin pencil lie at R/2 from the centre, and so 0.1 mm off this sensor."""
    scan = field_scans(lens)[0]
    curves = field_curves(lens, scan, [WAVE])
    angle = torch.deg2rad(scan.fields).norm(dim=-1)
    expected = (100.0 - RADIUS) * torch.cos(angle)
    assert (curves.tangential[:, 0] - expected).abs().max() < 1e-9
    assert (curves.sagittal[:, 0] - expected).abs().max() < 1e-9
    plane = mirror(sensor={"distance": RADIUS - 200.0}, stop_size=STOP, wavelengths=[WAVE])
    flat = field_curves(plane, scan, [WAVE])
    sag = RADIUS * (torch.cos(angle) - 1.0)
    # Against a plane the same foci lie off by the sag of the sphere, where the chief ray goes.
    assert (flat.tangential[:, 0] - expected - 100.0 / RADIUS * sag).abs().max() < 0.04


def test_a_wavefront_is_the_same_function_of_the_beam_at_every_field(lens):
    points = object_points(torch.tensor(FIELDS, dtype=torch.float64), None)
    waves = torch.full((len(FIELDS),), WAVE, dtype=torch.float64)
    system = lens.system()
    beam = find_beam(system, points, waves)
    # One grid for all, in the plane that faces each field.
    beam = dataclasses.replace(
        beam, centre=0.0 * beam.centre, half_width=0.7 * beam.half_width[:1].expand(4, 2)
    )
    front = pupil_wavefront(system, points, waves, samples=16, beam=beam)
    assert front.valid.all()
    opd = front.opd - front.opd[:, 8:9, 8:9]
    assert opd[0].abs().max() > 1e-5
    assert (opd - opd[0]).abs().max() < 1e-11
    assert (front.intercept - front.intercept[0]).abs().max() < 1e-11
    assert (front.direction - front.direction[0]).abs().max() < 1e-12


def test_spots_are_measured_along_the_surface(lens):
    """RMS of the spot against the closed form's own mean over the foreshortened beam."""
    spots = spot_diagram(lens, conditions(lens, FIELDS, [WAVE]), 20000)
    unit = torch.linspace(-1.0, 1.0, 801, dtype=torch.float64)
    x, y = torch.meshgrid(unit, unit, indexing="ij")
    inside = x * x + y * y < 1.0
    for field, angle in enumerate(ANGLES):
        heights = STOP * torch.hypot(x, y * math.cos(angle))[inside]
        expected = off_the_chief_ray(heights).square().mean().sqrt()
        assert float(spots.rms[field, 0]) == pytest.approx(float(expected), rel=2e-3)


def test_wavefronts_of_fields_are_about_where_the_light_lands(lens):
    found = field_wavefronts(lens, conditions(lens, FIELDS, [WAVE]))
    expected = torch.stack((0.0 * ANGLES, RADIUS * torch.sin(ANGLES)), -1)
    assert (found.centre - expected).abs().max() < 1e-6


def test_a_chief_ray_through_the_centre_meets_the_sensor_head_on(lens):
    properties = LensProperties(lens.system(), WAVE, None)
    wanted = operand({"kind": "chief_ray_angle", "max": 1.0, "field": [0.0, 40.0]}, lens)
    (angle,) = wanted.values(properties).values()
    assert float(angle) < 1e-6


def test_the_drawn_sensor_is_the_sphere(lens):
    curve = sensor_curve(lens.system(), 60.0)
    assert len(curve) > 20
    assert abs(math.hypot(*curve[0]) - RADIUS) < 1e-9
    assert abs(curve[0][1]) == pytest.approx(60.0)
    # It ends where the sphere does.
    assert abs(sensor_curve(lens.system(), 500.0)[:, 1]).max() <= RADIUS


def test_the_table_names_the_sensors_shape(lens):
    assert "-100.1" in repr(lens).splitlines()[-1]


SINGLET = {
    "surfaces": {
        "1": {"type": "sphere", "radius": 40.0, "semi_diameter": 5.0, "thickness": 3.0,
              "material": "1.5168/64.17"},
        "2": {"type": "sphere", "radius": -40.0, "semi_diameter": 5.0, "material": "air"},
    },
    "wavelengths": [WAVE],
    "sensor": {"distance": 38.0, "radius": -30.0},
}  # fmt: skip


def _render(lens):
    sensor, scene = Sensor(8, 8, 0.01), PlanarScene((1000.0,), (WAVE,))
    RayRenderer(sensor).render(lens, scene, torch.ones(1, 1, 8, 8), 0)


def _tolerances(lens):
    spots = gaussian_quadrature(lens, FIELDS[:1], [WAVE], 2, 4, symmetry=False)
    linear_spots(lens, spots, ["sensor_distance"])


def _best_focus(lens):
    variables = DesignVariables(lens, {"sensor_distance": {"solve": "best_focus"}})
    spots = gaussian_quadrature(lens, FIELDS[:1], [WAVE], 2, 4)
    MeritFunction(lens, variables, RayInterceptResiduals(spots, torch.ones(1)))


def _wavefront_merit(lens):
    spots = gaussian_quadrature(lens, FIELDS[:1], [WAVE], 2, 4)
    WavefrontResiduals(spots, torch.ones(1)).values(lens)


def _poses(lens):
    Pose(lens, [[0.0, 0.0, -1000.0]], {"sensor_distance": None})


@pytest.mark.parametrize(
    "attempt, what",
    [
        (_render, "rendering"),
        (_tolerances, "tolerances"),
        (_best_focus, "solve 'best_focus'"),
        (_wavefront_merit, "merit.quality 'wavefront'"),
        (_poses, "poses"),
    ],
)
def test_what_needs_a_plane_says_so(attempt, what):
    """One line each, rather than a number for a plane that is not there."""
    lens = lens_from_prescription(SINGLET)
    with pytest.raises(InputError) as error:
        attempt(lens)
    assert what in str(error.value)
    assert "the sensor is curved (radius -30 mm); only a plane one is held" in str(error.value)
