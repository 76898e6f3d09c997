"""Images and pupils of lenses with coatings: what is lost is lost everywhere alike."""

import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.ray_intercepts import trace_ray_intercepts
from dolens.analysis.spot_diagram import spot_diagram
from dolens.diffraction.field_wavefronts import field_wavefronts
from dolens.diffraction.illumination import relative_illumination
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
SENSOR = Sensor(24, 24, 1.0)
SCENE = PlanarScene((5000.0,), LINES)
WHITE = torch.ones(1, 3, 40, 40, dtype=torch.float64)


@pytest.fixture(scope="module")
def ideal():
    return load_lens("cooke_triplet").requires_grad_(False)


@pytest.fixture(scope="module")
def coated(ideal):
    return ideal.coated("quarter_wave").requires_grad_(False)


def test_a_white_plane_is_as_dark_as_the_analysis_of_its_light_says(ideal, coated):
    """The pixel in the middle of the sensor, each colour by its own share."""
    render = RayRenderer(Sensor(3, 3, 0.5), 8)
    both = [render.render(lens, SCENE, WHITE, 1) for lens in (coated, ideal)]
    ratio = (both[0] / both[1])[0, 0, :, 1, 1]
    known = coated.transmission(0.0, LINES, object_distance=5000.0).share[0]
    assert ratio.tolist() == pytest.approx(known.tolist(), abs=2e-4)


def test_renderers_lose_the_same_light(ideal, coated):
    """Of a plane without detail, on and off the axis; the same samples have the same noise."""
    settings = {"pupil_samples": 32, "fields": (3, 3), "size": 9}
    passed = []
    for render in (RayRenderer(SENSOR, 8), PsfRenderer(SENSOR, **settings)):
        both = [render.render(lens, SCENE, WHITE, 1) for lens in (coated, ideal)]
        passed.append(both[0] / both[1])
    assert 0.9 < float(passed[0].min()) < float(passed[0].max()) < 0.97
    assert float((passed[0] - passed[1]).abs().max()) < 5e-4


@pytest.mark.parametrize("name", ["surfaces.2.coating.thickness_1", "surfaces.1.curvature"])
def test_the_derivative_of_an_image_is_that_of_its_number(coated, name):
    render = RayRenderer(Sensor(5, 5, 4.0), 6)
    at = dict(coated.named_parameters())[name].detach()

    def light(value):
        return render.render(coated.with_values({name: value}), SCENE, WHITE, 3).sum()

    value = at.clone().requires_grad_()
    slope = float(torch.autograd.grad(light(value), value)[0])
    step = 1e-2 if "thickness" in name else 1e-6
    around = [float(light(at + s * step)) for s in (1.0, -1.0)]
    # Rays that a moving edge takes are an estimate, here of 36 a pixel.
    error = 1e-5 if "thickness" in name else 0.05
    assert slope == pytest.approx((around[0] - around[1]) / (2 * step), rel=error)


# All that passes at 0°, nothing at 60° and more, s and p alike.
STEEP = {"table": [[nm, a, 0, 0, 1 - a / 60, 1 - a / 60] for nm in (400, 700) for a in (0, 60)]}


# Of the first surface, mm: rays parallel to the axis meet it at the angle asin(h/R).
RADIUS = 22.01359


def height(rays):
    """Distance from the axis, mm."""
    return rays.position[..., :2].norm(dim=-1)


def test_pupils_are_weighed_by_what_passes(ideal):
    lens = ideal.coated({1: STEEP})
    where = conditions(lens, [0.0], [587.5618])
    pupil = torch.tensor([[0.0, 0.0], [0.0, 0.5], [0.0, 0.9]], dtype=torch.float64)
    light = trace_ray_intercepts(lens, where, pupil, exact=True).light[0, 0]
    aimed = lens.aim((0.0, 0.0), pupil, 587.5618)
    angle = torch.rad2deg(torch.asin(height(aimed) / RADIUS))
    assert light.tolist() == pytest.approx((1.0 - angle / 60.0).tolist(), abs=1e-4)
    front = field_wavefronts(lens, where).wavefront
    plain = field_wavefronts(ideal, where).wavefront
    assert bool((front.passed[front.valid] <= 1.0).all()) and plain.passed is None
    ratio = float(front.flux / plain.flux)
    # One is the mean over the entrance pupil, the other over the stop.
    assert ratio == pytest.approx(float(lens.transmission(0.0, 587.5618).share), abs=5e-3)


def test_a_spot_is_the_mean_over_the_light_that_arrives(ideal):
    lens = ideal.coated({1: STEEP})
    pupil, weight = uniform_pupil_points(2000)
    aimed = lens.aim((0.0, 0.0), pupil, 587.5618)
    hit = lens.trace(aimed, transmission=True)
    light = weight * hit.valid * (1.0 - torch.rad2deg(torch.asin(height(aimed) / RADIUS)) / 60.0)
    square = hit.position[:, :2].square().sum(-1)
    known = float((light * square).sum() / light.sum()) ** 0.5
    found = spot_diagram(lens, conditions(lens, [0.0], [587.5618])).rms
    assert float(found) == pytest.approx(known, rel=1e-4)


def test_relative_illumination_follows_the_coating(ideal):
    (scan,) = field_scans(ideal, None, 20.0)
    lens = ideal.coated({1: STEEP})
    plain, dark = (relative_illumination(x, scan).relative for x in (ideal, lens))
    share = [float(lens.transmission(field, 587.5618).share) for field in (0.0, 20.0)]
    assert float(dark[-1] / plain[-1]) == pytest.approx(share[1] / share[0], rel=0.02)
