"""Mirrors: closed forms of conics, textbook values of first and third order, fates of rays."""

import math

import pytest
import torch

from dolens import Rays, Status
from dolens.errors import InputError
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.kernels.trace_cases import LENSES

F64 = torch.float64


def mirror(radius, conic=0.0, size=40.0, **row):
    """A row of a prescription."""
    return {"type": "conic", "radius": radius, "conic": conic, "semi_diameter": size,
            "material": "mirror", **row}  # fmt: skip


def lens_of(rows, distance, **more):
    surfaces = {str(n): row for n, row in enumerate(rows, 1)}
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": distance}, **more})


def axial_beam(radius, z=-300.0, count=60):
    """Rays along the axis, spread over a disc."""
    k = torch.arange(count, dtype=F64)
    r, angle = radius * ((k + 0.5) / count).sqrt(), k * 2.399963
    position = torch.stack((r * angle.cos(), r * angle.sin(), torch.full_like(r, z)), -1)
    return Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=F64))


def from_point(z, directions):
    """Rays from a point of the axis towards +z."""
    across = torch.stack(directions, -1)
    along = (1.0 - across.square().sum(-1, keepdim=True)).sqrt()
    direction = torch.cat((across, along), -1)
    return Rays(torch.tensor([0.0, 0.0, z], dtype=F64).expand_as(direction), direction)


def cone(half_angle, count=40):
    """Direction cosines l, m of rays within a cone about the axis."""
    k = torch.arange(count, dtype=F64)
    sine, angle = math.sin(half_angle) * ((k + 0.5) / count).sqrt(), k * 2.399963
    return sine * angle.cos(), sine * angle.sin()


def test_a_paraboloid_images_an_axial_beam_perfectly():
    lens = lens_of([mirror(-200.0, -1.0, 90.0)], -100.0)
    hit = lens.trace(axial_beam(85.0))
    assert hit.valid.all()
    assert hit.position[:, :2].abs().max() < 1e-13
    assert (hit.position[:, 2] + 100.0).abs().max() == 0.0
    # From the plane z = -300 to the focus, as along the axis: 300 + 100 mm.
    assert (hit.path_length - 400.0).abs().max() < 1e-12
    assert (hit.direction.norm(dim=-1) - 1.0).abs().max() < 1e-15
    assert (hit.direction[:, 2] < 0.0).all()


def test_an_ellipsoid_images_one_focus_on_the_other():
    radius, e = -120.0, 0.6
    near, far = radius / (1.0 + e), radius / (1.0 - e)
    lens = lens_of([mirror(radius, -(e**2), 70.0)], far)
    hit = lens.trace(from_point(near, cone(0.7)))
    assert hit.valid.all()
    assert hit.position[:, :2].abs().max() < 1e-12
    # The sum of the distances to the foci is the major axis.
    assert (hit.path_length - abs(near + far)).abs().max() < 1e-12


def cassegrain():
    """A paraboloid of f = 500 and the hyperboloid with one focus there and one 300 mm behind it."""
    focus, gap, back = 500.0, 400.0, 300.0
    to_focus = focus - gap
    # A hyperboloid with foci at distances a and b behind and in front of its vertex.
    e = (back + to_focus) / (back - to_focus)
    radius = -2.0 * back * to_focus / (back - to_focus)
    rows = [
        mirror(-2.0 * focus, -1.0, 100.0, thickness=-gap),
        mirror(radius, -(e**2), 25.0),
    ]
    return lens_of(rows, back)


def test_a_hyperboloid_images_its_focus_and_a_cassegrain_an_axial_beam():
    lens = cassegrain()
    hit = lens.trace(axial_beam(95.0, z=-600.0))
    assert hit.valid.all()
    assert hit.position[:, :2].abs().max() < 1e-12
    # Of 1300 mm, in a few roundings: how many, the processor's instructions decide.
    differences = (hit.path_length - hit.path_length[0]).abs() / hit.path_length[0]
    assert differences.max() < 10.0 * torch.finfo(F64).eps
    assert (hit.direction[:, 2] > 0.0).all()
    first = lens.first_order()
    # The secondary magnifies three times.
    assert float(first.efl.detach()) == pytest.approx(1500.0, rel=1e-14)
    assert float(first.bfd.detach()) == pytest.approx(300.0, rel=1e-13)


def test_first_order_optics_of_one_concave_mirror():
    lens = lens_of([mirror(-200.0, size=20.0)], -100.0)
    first = lens.first_order(550.0)
    numbers = {
        "efl": 100.0, "power": 0.01, "bfd": -100.0, "focus": -100.0, "ffd": -100.0,
        "front_principal": 0.0, "rear_principal": 0.0, "front_nodal": -200.0, "rear_nodal": -200.0,
        "image_index": -1.0, "image": -100.0, "magnification": 0.0, "f_number": 2.5,
        "working_f_number": 2.5,
    }  # fmt: skip
    for name, value in numbers.items():
        assert float(getattr(first, name).detach()) == pytest.approx(value, abs=1e-12), name
    for pupil in (first.entrance_pupil, first.exit_pupil):
        assert [float(v.detach()) for v in pupil] == pytest.approx([0.0, 40.0])
    # An object at the centre of curvature is imaged on itself, upside down.
    near = lens.first_order(550.0, 200.0)
    assert float(near.image.detach()) == pytest.approx(-200.0)
    assert float(near.magnification.detach()) == pytest.approx(-1.0)
    numbers = ParaxialNumbers.of(lens.system())
    assert numbers.exit_pupil(550.0) == (0.0, 40.0)
    # Of an object 400 mm away: image height -f/(d - f) in the image plane 133.3 mm before it.
    assert numbers.chief_ray_magnification(550.0, 400.0) == pytest.approx(-100.0 / 400.0)


def test_real_rays_near_the_axis_are_the_paraxial_ones():
    lens = LENSES["mirrors"](None)
    first = lens.first_order(550.0)
    y = 1e-5
    ray = Rays(torch.tensor([0.0, y, -20.0], dtype=F64), torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    ray = Rays(ray.position, ray.direction, 550.0)
    hit = lens.trace(ray)
    slope = float((hit.direction[1] / hit.direction[2]).detach())
    # y-z curvature of the XY polynomial is not the mean over azimuth that first_order takes.
    turned = Rays(ray.position[[1, 0, 2]], ray.direction, 550.0)
    other = lens.trace(turned).direction
    mean = 0.5 * (slope + float((other[0] / other[2]).detach()))
    expected = -y * float((first.power / first.image_index).detach())
    assert mean == pytest.approx(expected, rel=2e-3)


def test_third_order_sums_of_a_paraboloid_and_of_a_sphere():
    """A sphere with the stop on it: S_I = -2c³y⁴, S_II, S_III = H²φ, S_IV = -H²φ; coma -φ²y²H/2.

    Schroeder, Astronomical Optics: off-axis aberrations at the mirror do not depend on the conic.
    """
    y, field = 20.0, 1.0
    sphere = lens_of([mirror(-200.0, size=y)], -100.0).seidel(field).total
    paraboloid = lens_of([mirror(-200.0, -1.0, size=y)], -100.0).seidel(field).total
    c, power = -1.0 / 200.0, 0.01
    invariant = -y * math.tan(math.radians(field))
    assert float(sphere.spherical.detach()) == pytest.approx(-2.0 * c**3 * y**4)
    assert float(paraboloid.spherical.detach()) == pytest.approx(0.0, abs=1e-18)
    for found in (sphere, paraboloid):
        assert float(found.astigmatism.detach()) == pytest.approx(invariant**2 * power)
        assert float(found.petzval.detach()) == pytest.approx(-(invariant**2) * power)
        coma = abs(float(found.coma.detach()))
        assert coma == pytest.approx(0.5 * power**2 * y**2 * abs(invariant))
        assert float(found.distortion.detach()) == pytest.approx(0.0, abs=1e-18)
        assert float(found.axial_color.detach()) == 0.0


def test_third_order_spherical_aberration_is_that_of_real_rays():
    """W = S_I·r⁴/8, and the transverse aberration 4W/(n'u'): of a sphere in the focal plane."""
    lens = lens_of([mirror(-2000.0, size=20.0)], -1000.0)
    y = 20.0 - 1e-9
    hit = lens.trace(Rays(torch.tensor([0.0, y, -9.0], dtype=F64), torch.tensor([0.0, 0.0, 1.0])))
    s = float(lens.seidel(0.0).total.spherical.detach())
    # n'u' = -y/f
    assert float(hit.position[1].detach()) == pytest.approx(0.5 * s / (-y / 1000.0), rel=1e-3)


def test_a_cassegrain_of_two_conics_has_no_spherical_aberration():
    """Each conic images its own axial object perfectly; a sphere in its place would not."""
    sums = cassegrain().seidel(0.5)
    assert sums.spherical.detach().abs().max() < 1e-13 * float(sums.coma.detach().abs().max())


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_ray_beside_a_mirror_and_one_that_it_sends_away(backend):
    lens = lens_of([mirror(-20.0, size=19.0)], -5.0)
    lens.backend = backend
    position = torch.tensor([[25.0, 0.0, -30.0], [19.5, 0.0, -30.0], [15.0, 0.0, -30.0],
                             [3.0, 0.0, -30.0]], dtype=F64)  # fmt: skip
    hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=F64)))
    assert hit.status.tolist() == [Status.MISSED, Status.MISSED, Status.MISSED, Status.OK]
    # At 45° and more of incidence the light goes on forwards, and never comes to the sensor.
    assert hit.surface.tolist() == [1, 2, 2, 0]


def test_a_prescription_with_mirrors_is_written_as_it_was_read():
    lens = LENSES["mirrors"](None)
    again = lens_from_prescription(prescription_of(lens))
    assert prescription_of(again) == prescription_of(lens)
    assert again.system().mirrors == (2, 4, 5, 6, 7, 8)
    assert again.system().senses == (1, 1, -1, -1, 1, -1, 1, -1, 1, 1, 1)
    assert [m.name for m in lens.materials][2] == "mirror"


def test_the_object_is_in_no_mirror():
    with pytest.raises(InputError, match="object cannot be in a mirror"):
        lens_of([mirror(-200.0)], -10.0, object_material="mirror")
