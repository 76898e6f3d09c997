"""Rays that travel almost across the axis: where they meet a dome from the side, or miss it."""

import math

import pytest
import torch

from dolens import Rays
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Status
from dolens.optics.surfaces.refraction import FAR
from dolens.prescriptions import lens_from_prescription

SEMI_DIAMETER = 1.1
DOMES = {
    "sphere": {"type": "sphere", "radius": 1.4},
    "conic": {"type": "conic", "radius": 1.4, "conic": 0.3},
    "asphere": {"type": "even_asphere", "radius": 1.4, "conic": 0.0, "a4": 1e-3},
    "polynomial": {"type": "xy_polynomial", "x2": 0.3, "y2": 0.3},
}


def dome(name):
    first = {**DOMES[name], "semi_diameter": SEMI_DIAMETER, "thickness": 1.0}
    second = {"type": "plane", "semi_diameter": SEMI_DIAMETER, "material": "air"}
    return lens_from_prescription(
        {
            "surfaces": {"1": {**first, "material": "1.5/60"}, "2": second},
            "sensor": {"distance": 1.0},
        },
        torch.float64,
    )


def rays_at(surface, count=20_000):
    """Rays to points of even density on a surface, with cosines of 1e-6 to 1e-2 to its axis."""
    generator = torch.Generator().manual_seed(0)
    u, v, w, b = torch.rand(4, count, generator=generator, dtype=torch.float64)
    radius, angle = 0.95 * SEMI_DIAMETER * u.sqrt(), 2.0 * math.pi * v
    x, y = radius * angle.cos(), radius * angle.sin()
    z = surface.shape.sag_and_gradient(surface.parameters, x, y)[0]
    n = 10.0 ** (-6.0 + 4.0 * w)
    across = (1.0 - n * n).sqrt()
    azimuth = 2.0 * math.pi * b
    direction = torch.stack([across * azimuth.cos(), across * azimuth.sin(), n], -1)
    return torch.stack([x, y, z], -1) - 5.0 * direction, direction


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("name", DOMES)
def test_a_grazing_ray_meets_the_surface_on_its_own_line_or_is_missed(name, backend):
    """Tracing goes by the vertex plane, which such a ray crosses far off; beyond 1000
    semi-diameters it is no longer followed.
    """
    system = dome(name).system().traced_by(backend)
    surface = system.surfaces[0]
    position, direction = rays_at(surface)
    with torch.no_grad():
        hit = trace_rays(system, Rays(position, direction, 587.56), last=1)
    met = hit.status != Status.MISSED
    assert 0.05 < float(met.double().mean()) < 0.9
    met = met & (hit.status != Status.VIGNETTED)
    where = hit.position[met]
    off_line = torch.linalg.cross(where - position[met], direction[met]).norm(dim=-1)
    sag = surface.shape.sag_and_gradient(surface.parameters, *where[:, :2].unbind(1))[0].detach()
    off_line = off_line.detach()
    assert float(off_line.max()) < 1e-11
    # Closed forms subtract squares of up to 1000 semi-diameters: ε·10⁶ of one.
    assert float((where[:, 2] - sag).abs().max()) < 1e-9
    # Where the vertex plane is crossed.
    crossing = position - position[:, 2:] / direction[:, 2:] * direction
    far = (crossing[:, :2].abs() > FAR * SEMI_DIAMETER).any(1)
    assert 0.2 < float(far.double().mean()) < 0.8
    assert (hit.status[far] == Status.MISSED).all()


def test_a_ray_along_a_tangent_converges_without_others_that_keep_the_iteration_going():
    """A wave of a mirror, found by random lenses; Newton's last step of √ε left 10⁵ roundings."""
    lens = lens_from_prescription(
        {
            "object_material": "1.5168/64.17",
            "surfaces": {
                "1": {
                    "type": "zernike_standard",
                    **{"radius": -349.0734772837016, "conic": 1.5099060535430908},
                    **{"z2": -0.1969477183361349, "z4": 0.19077592837637203},
                    **{"z37": 0.22211079280155652, "normalization_radius": 14.476516152974444},
                    **{"semi_diameter": 18.1, "material": "mirror"},
                }
            },
            "elements": {
                "1": {
                    "surfaces": [1, 1],
                    **{"tilt_x": 0.9582710266113281, "tilt_y": 0.22530877590179443},
                    **{"tilt_z": -2.1251142024993896},
                    "pivot": [7.433961184125138, 0.47653654934939027, 0.0],
                }
            },
            "sensor": {"distance": -129.2949730593735},
        },
        torch.float64,
        backend="cpu",
    )
    place = [[-40.37755586564004, -16.676876015810652, -0.7060404351849476]]
    along = [[-0.9691810693179199, -0.2463494568205364, 0.0]]
    place, along = (torch.tensor(vector, dtype=torch.float64) for vector in (place, along))
    shifts = torch.linspace(-1.0, 1.0, 201, dtype=torch.float64)[:, None]
    with torch.no_grad():
        alone = lens.trace(Rays(place, along))
        others = torch.cat((place.expand(201, 3)[:, :2], place[:, 2:] + shifts), 1)
        beside = lens.trace(Rays(others, along.expand(201, 3)))
    assert alone.valid.all() and beside.valid[100]
    assert float((alone.direction[0] - beside.direction[100]).abs().max()) < 1e-12
