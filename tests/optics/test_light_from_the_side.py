"""Light at 90 degrees to the axis and more: fields along one axis go on beyond 90°."""

import copy
import math

import pytest
import torch

from dolens import InputError, Rays, Status
from dolens.analysis.conditions import field_scans
from dolens.analysis.field_curves import parabasal_rays
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.optics.aiming import field_line
from dolens.plotting.layout import layout_drawing
from dolens.prescriptions.build import lens_from_prescription

RADIUS, INDEX = 10.0, 1.5
WAVE = 587.5618


def lens_with(surfaces, fields, stop, dtype=torch.float64, **more):
    prescription = {
        "stop": stop,
        "surfaces": surfaces,
        "sensor": {"distance": 20.0},
        "fields": {"angles": fields},
        **more,
    }
    return lens_from_prescription(prescription, dtype)


def ball(dtype=torch.float64, conic=None):
    """A ball of glass; its front half is met from the side."""
    shape = {"type": "sphere"} if conic is None else {"type": "conic", "conic": conic}
    half = {**shape, "semi_diameter": RADIUS}
    return lens_with(
        {
            "1": {**half, "radius": RADIUS, "thickness": 2 * RADIUS, "material": f"{INDEX}/60"},
            "2": {**half, "radius": -RADIUS, "material": "air"},
        },
        [[0, 100]],
        1,
        dtype,
    )


def fisheye(dtype=torch.float64):
    """Two strong menisci far in front of the stop."""
    glass, air = {"type": "sphere", "material": "1.7/60"}, {"type": "sphere", "material": "air"}
    return lens_with(
        {
            "1": {**glass, "radius": 40.0, "thickness": 2.0, "semi_diameter": 39.0},
            "2": {**air, "radius": 15.0, "thickness": 14.0, "semi_diameter": 14.9},
            "3": {**glass, "radius": 30.0, "thickness": 1.5, "semi_diameter": 29.0},
            "4": {**air, "radius": 8.0, "thickness": 16.0, "semi_diameter": 7.9},
            "5": {"type": "aperture", "semi_diameter": 0.5, "material": "air"},
        },
        [[0, 0], [0, 100]],
        5,
        dtype,
    )


def turned(vectors, degrees):
    """Turn vectors (..., 3) about x, +z towards +y."""
    a = math.radians(degrees)
    x, y, z = vectors.unbind(-1)
    return torch.stack(
        (x, y * math.cos(a) + z * math.sin(a), z * math.cos(a) - y * math.sin(a)), -1
    )


def test_the_direction_of_a_field_goes_on_beyond_90_degrees():
    """Below it is (tan x, tan y, 1); along one axis it is a turn by the angle."""
    both = torch.deg2rad(torch.tensor([[30.0, -50.0], [89.0, 70.0]], dtype=torch.float64))
    line, _ = field_line(both)
    expected = torch.cat((both.tan(), torch.ones(2, 1)), -1)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(line, expected, rtol=1e-13, atol=1e-15)
    angle = math.radians(105.0)
    line, _ = field_line(torch.tensor([[0.0, angle], [-angle, 0.0]], dtype=torch.float64))
    sine, cosine = math.sin(angle), math.cos(angle)
    expected = torch.tensor([[0.0, sine, cosine], [-sine, 0.0, cosine]], dtype=torch.float64)
    torch.testing.assert_close(line, expected, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("field", [90.0, 100.0, 140.0])
@pytest.mark.parametrize("dtype, allowed", [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_a_sphere_looks_the_same_from_the_side(field, dtype, allowed):
    """Turned about the centre of the sphere, a ray of the axis is one of the field: so are the
    point where it enters and the refracted ray.  Users' rays are double for both lenses.
    """
    centre = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)
    forwards = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    # They enter on the side of the vertex when turned: within 80° of it.
    heights = torch.tensor([[2.0, 0.9], [0.0, 0.85], [-3.0, 0.93]], dtype=torch.float64)
    y = RADIUS * torch.sin(torch.deg2rad(torch.tensor(field - 75.0)).double())
    points = torch.stack((heights[:, 0], y * heights[:, 1], torch.full((3,), -5.0)), -1).double()
    lens = ball(dtype)
    straight = lens.trace(Rays(points, forwards.expand(3, 3), WAVE), record=True, last=1)
    side = Rays(turned(points - centre, field) + centre, turned(forwards.expand(3, 3), field), WAVE)
    found = lens.trace(side, record=True, last=1)
    assert straight.valid.all() and found.valid.all()
    expected = turned(straight.position.double() - centre, field) + centre
    torch.testing.assert_close(found.position.double(), expected, rtol=0.0, atol=RADIUS * allowed)
    expected = turned(straight.direction.double(), field)
    torch.testing.assert_close(found.direction.double(), expected, rtol=0.0, atol=allowed)
    torch.testing.assert_close(
        found.path_length, straight.path_length, rtol=0.0, atol=RADIUS * allowed
    )


def test_a_ray_that_enters_behind_the_equator_misses_the_front_half():
    """A hemisphere ends at its equator, seen from the side too."""
    direction = torch.tensor([0.0, math.sin(math.radians(100.0)), math.cos(math.radians(100.0))])
    centre = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)
    through = Rays(centre - 3 * RADIUS * direction.double(), direction.double(), WAVE)
    hit = ball().trace(through)
    assert (int(hit.status), int(hit.surface)) == (Status.MISSED, 1)


@pytest.mark.parametrize("conic", [-0.5, 0.7])
def test_conics_are_met_from_the_side_where_their_equation_says(conic):
    """The point lies on x² + y² + (1+k)z² = 2Rz and on the ray, and the ray goes in."""
    lens = ball(conic=conic if conic < 0.0 else 0.0)
    with torch.no_grad():
        lens.surfaces["1"].conic.fill_(conic)
    angle = math.radians(97.0)
    direction = torch.tensor([0.0, math.sin(angle), math.cos(angle)], dtype=torch.float64)
    at = torch.tensor([1.0, -4.0, 0.0], dtype=torch.float64)
    at[2] = (
        lens.surfaces["1"].curvature.detach()
        * 17.0
        / (1.0 + math.sqrt(1.0 - (1.0 + conic) * 17.0 / RADIUS**2))
    )
    hit = lens.trace(Rays(at - 30.0 * direction, direction, WAVE), last=1)
    torch.testing.assert_close(hit.position, at, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("dtype, allowed", [(torch.float64, 1e-9), (torch.float32, 1e-2)])
def test_the_chief_ray_is_the_one_sent_back_from_the_stop(dtype, allowed):
    """Light goes back the way it came: rays from the centre of the stop leave a fisheye at 78° to
    103°, and the chief rays of these fields are they.
    """
    lens = fisheye(dtype)
    slopes = torch.linspace(0.45, 0.65, 5, dtype=torch.float64)
    start = torch.stack((0 * slopes, 0 * slopes, 0 * slopes + 33.5), -1)
    back = -torch.stack((0 * slopes, slopes, torch.ones_like(slopes)), -1)
    back = back / back.norm(dim=-1, keepdim=True)
    sent = fisheye().sensor_to_scene(Rays(start, back, WAVE), last=4)
    assert ((sent.status == Status.OK) | (sent.status == Status.VIGNETTED)).all()
    field = torch.rad2deg(torch.atan2(-sent.direction[:, 1], -sent.direction[:, 2]))
    assert field.min() < 80.0 and field.max() > 100.0
    chief = lens.chief_ray(torch.stack((0 * field, field), -1), WAVE)
    assert chief.converged.all()
    met = lens.trace(chief, record=True, last=1).points[0].double()
    torch.testing.assert_close(met, sent.position, rtol=0.0, atol=allowed)


def test_aimed_rays_from_the_side_have_their_derivatives():
    """A ray of 95° moves on the sensor with the front curvature as differences say."""
    lens = fisheye()

    def height(change):
        moved = copy.deepcopy(lens)
        with torch.no_grad():
            moved.surfaces["1"].curvature.add_(change)
        return moved.trace(moved.aim((0.0, 95.0), (0.3, 0.8), WAVE)).position[1], moved

    value, same = height(0.0)
    (found,) = torch.autograd.grad(value, same.surfaces["1"].curvature)
    step = 1e-6
    with torch.no_grad():
        expected = (height(step)[0] - height(-step)[0]) / (2 * step)
    assert float(found) == pytest.approx(float(expected), rel=1e-6)


def test_what_needs_a_tangent_refuses_fields_from_the_side():
    """Each says in one line that fields must be below 90 degrees."""
    lens = fisheye()
    (scan,) = field_scans(lens, edge=95.0, count=2)
    with pytest.raises(InputError, match="below 90 degrees"):
        parabasal_rays(lens, scan, [WAVE])
    with pytest.raises(InputError, match="90 degrees"):
        ObjectPoints.at_infinity([[0.0, 95.0]])
    front = {"1": {"type": "sphere", "radius": 30.0, "semi_diameter": 5.0, "material": "1.5/60"}}
    with pytest.raises(InputError, match="below 90 degrees"):
        lens_with(front, [[10, 95]], 1)
    with pytest.raises(InputError, match="below 90 degrees"):
        lens_with(front, [[0, 95]], 1, object_distance=100.0)
    lens.backend = "cpu"
    with pytest.raises(InputError, match="kernels trace no light at 90 degrees"):
        lens.trace(lens.chief_ray((0.0, 95.0)))


def test_a_drawing_shows_light_that_comes_from_behind_the_front():
    """The chief ray of 90.5° is drawn straight to the first surface, falling towards -z, and
    through the centre of the stop.
    """
    (fan,) = layout_drawing(fisheye().requires_grad_(False), WAVE, [90.5], 1).fans
    (path,) = fan.paths
    along = path[1] - path[0]
    assert math.degrees(math.atan2(along[1], along[2])) == pytest.approx(90.5, abs=1e-9)
    assert path[5] == pytest.approx([0.0, 0.0, 33.5], abs=1e-9)
