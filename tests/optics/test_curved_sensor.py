"""A curved sensor: rays end where they meet it, to the last digits, with their derivatives."""

import math

import pytest
import torch

from dolens import InputError, Rays, load_lens
from dolens.optics.rays import Status
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.kernels.trace_cases import LENSES, bundle
from tests.optics import exact

F64 = torch.float64


def mirror(radius=-200.0, sensor=None, stop_size=20.0, **more):
    """A spherical mirror with its stop at the centre of curvature, and its concentric image."""
    surfaces = {
        "1": {"type": "aperture", "semi_diameter": stop_size, "thickness": -radius,
              "material": "air"},
        "2": {"type": "sphere", "radius": radius, "semi_diameter": 150.0, "material": "mirror"},
    }  # fmt: skip
    sensor = sensor or {"distance": radius / 2.0, "radius": radius / 2.0}
    return lens_from_prescription({"surfaces": surfaces, "sensor": sensor, **more})


def parallel(angle, heights):
    """Rays of one field in the y-z plane, by their distance from the one through the centre."""
    c, s = math.cos(angle), math.sin(angle)
    start = torch.stack([torch.zeros_like(heights), heights * c, -heights * s], -1)
    # From in front of the stop, whatever its tilt to the beam.
    direction = torch.tensor([0.0, s, c], dtype=F64).expand_as(start)
    return Rays(start - 50.0 * direction, direction, 550.0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_sphere_about_the_stop_sees_every_field_alike(backend):
    """A concentric system turns with its field: on the sphere |p| = f about the centre each ray
    lands at the angle of its field plus that of its height, whatever the field.
    """
    lens = mirror()
    lens.backend = backend
    heights = torch.linspace(-10.0, 10.0, 21, dtype=F64)
    landed = []
    for angle in (0.0, 0.3, 0.7, -1.0):
        hit = lens.trace(parallel(angle, heights))
        radius, around = hit.position.norm(dim=-1), torch.atan2(*hit.position[:, 1:].T)
        assert (hit.status != Status.MISSED).all()
        assert (radius - 100.0).abs().max() < 1e-12
        landed.append(around - angle)
    assert (torch.stack(landed) - landed[0]).abs().max() < 1e-14
    # A ray at height h crosses the axis of its field at R/(2·cos i), sin i = h/R, and goes on to
    # the sphere: closed form, by elementary trigonometry.
    i = torch.asin(heights / 200.0)
    distance = 100.0 / torch.cos(i)
    # From the crossing the ray leaves the axis at 2i, and reaches |p| = 100 inside of it.
    beta = torch.asin(distance * torch.sin(2.0 * i) / 100.0)
    assert (landed[0].abs() - (beta - 2.0 * i).abs()).abs().max() < 1e-14


@pytest.mark.parametrize("name", ["retina", "folded_film"])
def test_the_intersection_is_that_of_80_digits(name, root):
    lens = LENSES[name](root)
    rays = bundle(lens, 24, fill=1.3 if name == "retina" else 0.8)
    hit = lens.trace(rays)
    assert (hit.status == Status.MISSED).any() or name != "retina"
    values = exact.values_of(lens)
    compared = 0
    for ray in range(24):
        start, direction = (
            [exact.mp.mpf(float(v)) for v in part[ray]] for part in (rays.position, rays.direction)
        )
        status, surface, point, path, _ = exact.trace(lens, values, start, direction, 550.0)
        assert (int(hit.status[ray]), int(hit.surface[ray])) == (status, surface)
        if point is None:
            continue
        compared += 1
        found = hit.position[ray].tolist()
        error = [abs(exact.mp.mpf(a) - b) for a, b in zip(found, point, strict=True)]
        assert max(error) < 1e-12
        assert abs(exact.mp.mpf(hit.path_length[ray].item()) - path) < 1e-12
    assert compared > 8


def test_a_parabola_collects_its_own_focal_plane():
    """On the paraboloid z = -y²/4f' a ray parallel to the axis at height h lands at that height."""
    lens = mirror(sensor={"distance": -60.0, "radius": 80.0, "conic": -1.0})
    start = torch.tensor([[3.0, 4.0, -10.0], [0.0, 0.0, -10.0]], dtype=F64)
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(2, 3)
    hit = lens.trace(Rays(start, ahead, 550.0))
    x, y, z = (hit.position - torch.tensor([0.0, 0.0, 140.0], dtype=F64)).unbind(-1)
    assert (z - (x * x + y * y) / 160.0).abs().max() < 1e-13
    assert z[0] > 1e-3 and z[1] == 0.0


def test_rays_beyond_the_rim_miss_the_sensor():
    lens = mirror(sensor={"distance": -100.0, "radius": -1.0})
    hit = lens.trace(parallel(0.0, torch.tensor([1.0, 18.0], dtype=F64)))
    far = lens.trace(parallel(0.1, torch.tensor([0.0], dtype=F64)))
    assert hit.status[0] == Status.OK
    assert far.status[0] == Status.MISSED and far.surface[0] == 3
    assert torch.isfinite(far.position).all() and torch.isfinite(far.path_length).all()


def test_a_plane_has_no_further_parameters_and_the_same_numbers(root):
    """The state of a lens does not change; a sphere of no curvature is the plane."""
    plane = load_lens(root / "conf/lens/cooke_triplet.yaml")
    assert not [name for name in plane.state_dict() if name.startswith("sensor_c")]
    row = prescription_of(plane)
    flat = lens_from_prescription(row | {"sensor": row["sensor"] | {"radius": math.inf}})
    assert "sensor_curvature" in flat.state_dict() and "sensor_conic" not in flat.state_dict()
    rays = bundle(plane)
    for backend in ("reference", "cpu"):
        plane.backend = flat.backend = backend
        a, b = plane.trace(rays), flat.trace(rays)
        assert (a.position - b.position).abs().max() < 1e-13
        assert torch.equal(a.status, b.status)


def test_a_prescription_gives_it_back():
    lens = mirror(sensor={"distance": -100.0, "radius": -97.3, "conic": 0.4, "diameter": 50.0})
    again = lens_from_prescription(prescription_of(lens))
    assert prescription_of(again)["sensor"] == {
        "distance": -100.0, "diameter": 50.0, "radius": -97.3, "conic": 0.4
    }  # fmt: skip
    assert torch.equal(again.sensor_curvature, lens.sensor_curvature)


@pytest.mark.parametrize(
    "sensor, message",
    [
        ({"conic": -1.0}, "'radius' is missing"),
        ({"radius": 0.0}, "'radius' is 0; write .inf for a plane"),
        ({"radius": 10.0, "curvature": 0.1}, "give 'radius' or 'curvature', not both"),
        ({"radius": "flat"}, "'radius' must be a number"),
        ({"raduis": 10.0}, "sensor: unknown key 'raduis'; did you mean 'radius'"),
    ],
)
def test_bad_sensors_are_one_clear_line(sensor, message):
    with pytest.raises(InputError) as error:
        mirror(sensor={"distance": -100.0, **sensor})
    assert message in str(error.value) and "\n" not in str(error.value)
