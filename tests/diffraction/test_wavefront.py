"""Wavefronts on reference spheres."""

import copy
import math

import pytest
import torch
from scipy.integrate import dblquad

from dolens import Lens, load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.ray_intercepts import trace_ray_intercepts
from dolens.diffraction.entrance_beam import ObjectPoints, find_beam
from dolens.diffraction.pupil_fit import chebyshev, fit_pupil
from dolens.diffraction.wavefront import Wavefront, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.elements import Element
from dolens.optics.surfaces.conic import Conic
from dolens.optics.surfaces.plane import Plane
from tests.diffraction.perfect_lenses import (
    AIR,
    GLASS,
    N,
    ellipse,
    hyperbola,
    hyperbola_height,
    pinhole,
    relay,
)

AXIS = ObjectPoints.at_infinity([[0.0, 0.0]])
CENTRE = [[0.0, 0.0]]


def worst(wavefront: Wavefront) -> float:
    """Largest |OPD| of rays that pass, mm."""
    return float((wavefront.opd.abs() * (wavefront.coverage > 0.0)).detach().max())


@pytest.mark.parametrize(
    "lens, points",
    [
        (hyperbola(aperture=2.5), AXIS),
        (hyperbola(aperture=12.5), AXIS),
        (ellipse(), AXIS),
        (relay(80.0), ObjectPoints.at([[0.0, 0.0, -80.0]])),
        (relay(8000.0), ObjectPoints.at([[0.0, 0.0, -8000.0]])),
        (relay(1e9), ObjectPoints.at([[0.0, 0.0, -1e9]])),
    ],
    ids=["f/10", "f/2", "into glass", "near", "8 m", "1000 km"],
)
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_perfect_lens_has_a_spherical_wavefront(lens, points, backend):
    found = pupil_wavefront(lens.system().traced_by(backend), points, 500.0, CENTRE, 48)
    assert worst(found) < 1e-12
    assert float(found.strehl_ratio.detach()) == pytest.approx(1.0, abs=1e-12)
    # A stop on a curved surface is not the paraxial pupil, by its sag over the object's distance.
    near = float(points.vergence) > 1e-3
    assert float(found.flux.detach()) == pytest.approx(1.0, abs=1e-2 if near else 1e-4)


@pytest.mark.parametrize("radius", [51.0, 20.0, 1e6, math.inf, -40.0])
def test_defocus_on_any_sphere_is_the_distance_to_the_focus(radius):
    """From the focus, δ before the sphere's centre, to its point at the angle θ it is
    √(R² + δ² - 2Rδ·cos θ); of that R·(...) is left out, which tends to -δ·cos θ.
    """
    shift = 0.3
    lens = hyperbola(aperture=10.0, defocus=shift)
    found = pupil_wavefront(lens.system(), AXIS, 500.0, CENTRE, 32, radius)
    lit = found.coverage > 0.0
    cosine = (1.0 - found.direction.square().sum(-1)).sqrt()
    curvature = 1.0 / radius
    # Both over R, so that it may be infinite.
    step = shift * (shift * curvature - 2.0 * cosine)
    from_focus = step / (1.0 + (1.0 + curvature * step).sqrt())
    assert float(found.curvature) == pytest.approx(curvature)
    wrong = (found.opd + from_focus)[lit].detach()
    assert float(wrong.max() - wrong.min()) < 1e-12
    assert float((from_focus[lit].max() - from_focus[lit].min()).detach()) > 1e-3


def test_two_spheres_cut_the_same_rays(triplet):
    points = ObjectPoints.at_infinity([[3.0, 14.0]])
    chief = trace_ray_intercepts(
        triplet, conditions(triplet, [(3.0, 14.0)], [587.5618]), torch.zeros(1, 2), exact=True
    )
    found = pupil_wavefront(triplet.system(), points, 587.5618, samples=16)
    assert torch.allclose(found.centre, chief.chief, atol=1e-10)
    radius = 1.0 / float(found.curvature)
    small = pupil_wavefront(triplet.system(), points, 587.5618, chief.chief, 16, 0.5 * radius)
    lit = found.coverage > 0.0

    def sphere(wavefront: Wavefront, radius: float) -> torch.Tensor:
        alpha = wavefront.direction[lit]
        z = (1.0 - alpha.square().sum(-1)).sqrt()
        return -radius * torch.cat([alpha, z[:, None]], -1)

    far, near = sphere(found, radius), sphere(small, 0.5 * radius)
    landing = torch.nn.functional.pad(found.intercept[lit], (0, 1))
    gone = (near - far).norm(dim=-1)
    to_sensor = (landing - far) / (landing - far).norm(dim=-1, keepdim=True)
    assert torch.allclose(near - far, gone[:, None] * to_sensor, atol=1e-10)
    wrong = (small.opd - found.opd)[lit] - gone
    assert float(wrong.max() - wrong.min()) < 1e-12


def test_a_far_object_is_as_exact_as_one_at_infinity(triplet):
    """The light of a star and of a point a light-year away differ by q²/2D."""
    angle = math.tan(math.radians(14.0))
    star = pupil_wavefront(triplet.system(), ObjectPoints.at_infinity([[0.0, 14.0]]), 550.0)
    for distance in (1e7, 1e12, 9.5e18):
        point = ObjectPoints.at([[0.0, -angle * distance, -distance]])
        near = pupil_wavefront(triplet.system(), point, 550.0, star.centre)
        wrong = ((near.opd - star.opd) * star.coverage).abs().max()
        assert float(wrong) < 40.0 / distance + 1e-12


@pytest.mark.parametrize("aperture", [0.5, 1.0])
def test_a_singlet_s_wavefront_is_its_seidel_sum(aperture):
    """W = S_I·r⁴/8 at the paraxial focus; Welford's W is early light, the OPD late."""
    lens = hyperbola(aperture=aperture)
    with torch.no_grad():
        lens.surfaces["2"].conic.fill_(0.0)
        spherical = float(lens.seidel(0.1, 500.0).total.spherical)
    found = pupil_wavefront(lens.system(), AXIS, 500.0, CENTRE, 160, math.inf)
    r2 = found.direction.square().sum(-1) / (aperture / 50.0) ** 2
    expected = -spherical / 8.0 * (r2 * r2 - 1.0 / 3.0)
    wrong = (found.opd - expected) * found.coverage
    assert spherical > 0.0
    # What is left are higher orders, which grow with the square of the aperture.
    assert float(wrong.abs().max()) < 0.004 * aperture**2 * spherical / 8.0
    # Over the disc r⁴ has variance 1/5 - 1/9.
    sigma = spherical / 8.0 * math.sqrt(4.0 / 45.0)
    assert float(found.rms) == pytest.approx(sigma, rel=0.002 + 0.005 * aperture**2)


@pytest.mark.parametrize("case", range(4), ids=["axis", "14°", "20°", "5 m"])
def test_the_triplet_s_wavefront_is_that_of_optiland(case, triplet, reference):
    """See tests/reference/wavefront_optiland.py; its OPD has Welford's sign."""
    document = reference("wavefront_optiland.json")
    row = document["cases"][case]
    points, centre = object_point(row), torch.tensor(row["centre"], dtype=torch.float64)
    found = pupil_wavefront(
        triplet.system(), points, document["wavelength_nm"], centre[None, :2], 32, row["radius"]
    )
    own = pupil_wavefront(triplet.system(), points, document["wavelength_nm"], centre[None, :2])
    assert 1.0 / float(own.curvature) == pytest.approx(row["radius"], rel=1e-12)

    fit = fit_pupil(found, 12)
    sphere = torch.tensor([row["sphere_x"], row["sphere_y"]], dtype=torch.float64)
    alpha = (centre[:2, None] - sphere) / row["radius"]
    unit = (alpha - fit.centre[0, :, None]) / fit.half_width[0, :, None]
    x, y = (chebyshev(u[None], 12)[0][0] for u in unit)
    opd = ((fit.coefficients[0, 0] @ x) * y).sum(0) / (1e-6 * document["wavelength_nm"])
    wrong = opd + torch.tensor(row["opd_waves"], dtype=torch.float64)
    assert opd.numel() > 60
    assert float(opd.max() - opd.min()) > 0.5
    assert float(wrong.max() - wrong.min()) < 2e-6


def object_point(row: dict) -> ObjectPoints:
    if row["object_distance"] is None:
        return ObjectPoints.at_infinity([[0.0, row["field"]]])
    return ObjectPoints.at([[0.0, row["field"], -row["object_distance"]]])


@pytest.mark.parametrize(
    "name, field", [("nikon", 0.0), ("nikon", 20.0), ("nikon", 32.0), ("large_fov_doublet", 20.0)]
)
def test_a_beam_is_as_wide_as_that_of_aimed_rays(name, field, root):
    """The search, which knows nothing of the stop, against rays through points of the stop."""
    lens = load_lens(root / f"conf/lens/{name}.yaml").requires_grad_(False)
    points = ObjectPoints.at_infinity([[0.0, field]])
    found = find_beam(lens.system(), points, torch.tensor([587.5618]).double())
    radius = torch.linspace(0.04, 0.9999, 25).double()[:, None]
    angle = torch.linspace(0.0, 2.0 * math.pi, 72).double()
    pupil = torch.stack((radius * angle.cos(), radius * angle.sin()), -1)
    aimed = lens.aim([0.0, field], pupil, 587.5618)
    q = aimed.crossing[lens.trace(aimed).valid]
    low, high = q.amin(0), q.amax(0)
    assert bool((found.centre - found.half_width < low).all())
    assert bool((found.centre + found.half_width > high).all())
    # Rays lie a twenty-fourth of the width apart at most.
    assert bool((found.half_width < 1.12 * 0.5 * (high - low)).all())


@pytest.mark.parametrize("field", [0.0, 10.0, 35.0])
def test_light_through_a_hole_falls_as_cos4(field):
    points = ObjectPoints.at_infinity([[0.6 * field, 0.8 * field]])
    found = pupil_wavefront(pinhole(2.0).system(), points, 500.0, samples=64)
    cosine = 1.0 / math.sqrt(1.0 + float(points.slopes.square().sum()))
    assert float(found.flux) == pytest.approx(cosine**4, rel=1e-4)


def test_a_near_point_s_light_through_a_hole():
    """∫cos θ dΩ = ∫z²/(r² + z²)² dA over the hole, relative to that of the axial point."""
    radius, x, z = 3.0, 4.0, 10.0
    points = ObjectPoints.at([[x, 0.0, -z], [0.0, 0.0, -z]])
    found = pupil_wavefront(pinhole(radius).system(), points, 500.0, samples=96)

    def light(x: float) -> float:
        def density(v: float, u: float) -> float:
            return z * z / ((u - x) ** 2 + v * v + z * z) ** 2

        def edge(u: float) -> float:
            return math.sqrt(radius**2 - u * u)

        return dblquad(density, -radius, radius, lambda u: -edge(u), edge)[0]

    assert found.flux.tolist() == pytest.approx([light(x) / light(0.0), 1.0], rel=2e-4)


def test_two_holes_pass_what_both_pass():
    """Circles of one radius a, their centres g·tan θ apart: a lens of known area."""
    a, gap, field = 2.0, 10.0, 8.0
    lens = pinhole(a, second=(gap, a))
    found = pupil_wavefront(
        lens.system(), ObjectPoints.at_infinity([[field, 0.0]]), 500.0, samples=96
    )
    d = gap * math.tan(math.radians(field))
    area = 2.0 * a * a * math.acos(d / (2 * a)) - 0.5 * d * math.sqrt(4 * a * a - d * d)
    cos4 = math.cos(math.radians(field)) ** 4
    assert float(found.flux) == pytest.approx(cos4 * area / (math.pi * a * a), rel=3e-4)
    assert sorted(found.clipping) == [1, 2]


def test_a_moved_stop_moves_its_light():
    lens = pinhole(2.0)
    pose = {"decenter_x": 5.0, "decenter_y": -3.0, "tilt_x": 0.3}
    lens.elements["hole"] = Element(1, 1, pose).requires_grad_(False)
    found = pupil_wavefront(lens.system(), AXIS, 500.0, CENTRE, 48)
    share = found.weight / found.weight.sum()
    assert float((share * found.intercept[..., 0]).sum()) == pytest.approx(5.0, abs=1e-4)
    assert float((share * found.intercept[..., 1]).sum()) == pytest.approx(-3.0, abs=1e-4)
    # A tilted hole is narrower by its cosine.
    assert float(found.flux) == pytest.approx(math.cos(0.3), rel=2e-4)


def test_the_amplitude_of_a_perfect_lens():
    """Equal areas before the lens; A² = h·dh/(s·ds), s = sin θ, over the stop's area."""
    found = pupil_wavefront(hyperbola(aperture=12.5).system(), AXIS, 500.0, CENTRE, 48)
    lit = found.coverage > 0.0
    sines = found.direction.norm(dim=-1)[lit].tolist()
    step = 1e-5

    def density(s: float) -> float:
        after, before = (hyperbola_height(s + d, 50.0) for d in (step, -step))
        return (after**2 - before**2) / (4.0 * step * s) / (math.pi * 12.5**2)

    expected = torch.tensor([density(s) for s in sines], dtype=torch.float64)
    assert torch.allclose(found.amplitude[lit].square(), expected, rtol=1e-5)


def test_the_pupil_of_a_telecentric_lens_lies_at_infinity():
    """With the stop in its front focal plane; spheres of growing radius tend to that."""
    lens = hyperbola(focal_length=50.0, aperture=5.0, gap=50.0, defocus=0.05)
    points = ObjectPoints.at_infinity([[0.0, 2.0]])
    with torch.no_grad():
        # The front focus lies before the plane by f less the glass's reduced thickness.
        lens.thicknesses["1"].fill_(50.0 - 4.0 / N)
    found = pupil_wavefront(lens.system(), points, 500.0)
    large = pupil_wavefront(lens.system(), points, 500.0, found.centre, radius=1e9)
    assert abs(float(found.curvature)) < 1e-12
    assert float((found.opd - large.opd).abs().max()) < 1e-9
    assert float(found.rms) > 1e-4


def test_a_pupil_behind_the_sensor_has_a_sphere_there():
    """The stop 2f before a lens is imaged 2f behind it, f behind the sensor."""
    lens = hyperbola(focal_length=50.0, aperture=2.0, gap=100.0 - 4.0 / N, defocus=0.05)
    found = pupil_wavefront(lens.system(), AXIS, 500.0, CENTRE)
    assert 1.0 / float(found.curvature) == pytest.approx(-50.0, abs=0.06)
    assert float(found.rms) > 1e-6
    # Defocus is the same from either side.
    front = pupil_wavefront(lens.system(), AXIS, 500.0, CENTRE, radius=50.0)
    assert float(found.rms) == pytest.approx(float(front.rms), rel=5e-3)


def test_a_lens_in_single_precision_is_traced_in_double():
    single = hyperbola(aperture=5.0, dtype=torch.float32).requires_grad_(True)
    single.surfaces.to(torch.float32)
    found = pupil_wavefront(single.system(), AXIS, 500.0, CENTRE)
    double = copy.deepcopy(single).to(torch.float64)
    expected = pupil_wavefront(double.system(), AXIS, 500.0, CENTRE)
    assert single.dtype == torch.float32 and found.opd.dtype == torch.float64
    assert float((found.opd - expected.opd).detach().abs().max()) < 1e-13
    found.rms.sum().backward()
    assert single.sensor_distance.grad.dtype == torch.float32


def test_rays_that_are_reflected_totally_end_the_pupil():
    """A plano-convex lens from its plane side: from R/n on the rear surface reflects all."""
    rear = Conic(9.0, {"curvature": -0.1, "conic": 0.0})
    lens = Lens([Plane(9.0, {}), rear], [9.0], 14.0, [AIR, GLASS, AIR], stop=1)
    found = pupil_wavefront(lens.system(), AXIS, 500.0, CENTRE, 48)
    assert bool(found.ended)
    assert not bool(found.valid.all())
    for values in (found.opd, found.direction, found.amplitude, found.area, found.intercept):
        assert bool(torch.isfinite(values).all())
    # The differences take rays to two cells around, and so lose the last of those that pass.
    expected = (10.0 / N / 9.0) ** 2
    assert 0.8 * expected < float(found.flux.detach()) < expected
    gradient = torch.autograd.grad(
        found.opd.sum() + found.weight.sum(), [rear.curvature, lens.sensor_distance]
    )
    assert all(bool(torch.isfinite(g)) for g in gradient)
    assert bool((found.opd[~found.valid] == 0.0).all())


def test_a_dark_point_has_no_light_and_spoils_no_other(triplet):
    fields = ObjectPoints.at_infinity([[0.0, 60.0], [0.0, 5.0]])
    centres = [[0.0, 40.0], [0.0, 4.3]]
    triplet.requires_grad_(True)
    both = pupil_wavefront(triplet.system(), fields, 587.5618, centres)
    own = pupil_wavefront(triplet.system(), fields[torch.tensor([1])], 587.5618, centres[1:])
    assert float(both.flux[0].detach()) == 0.0
    assert float(both.flux[1].detach()) == pytest.approx(float(own.flux.detach()), rel=1e-3)
    (both.rms[1] + both.flux.sum()).backward()
    for name, parameter in triplet.named_parameters():
        assert parameter.grad is None or bool(torch.isfinite(parameter.grad)), name


@pytest.mark.parametrize("name, step", [("surfaces.1.curvature", 1e-6), ("thicknesses.2", 1e-5)])
def test_gradients_are_derivatives(triplet, name, step):
    """Of the flux too: what changes is where the stop's edge falls among the rays."""
    points = ObjectPoints.at([[100.0, 900.0, -4000.0]])
    stored = dict(triplet.named_parameters())[name].detach()
    wavelength = torch.tensor([587.5618]).double()
    beam = find_beam(triplet.system(), points, wavelength)

    def values(x: torch.Tensor) -> torch.Tensor:
        system = triplet.system({name: x})
        centre = [[-1.2, -11.0]]
        found = pupil_wavefront(system, points, wavelength, centre, 24, 52.0, beam=beam)
        return torch.stack((1e3 * found.rms[0], found.flux[0], found.strehl_ratio[0]))

    x = stored.clone().requires_grad_()
    gradient = [torch.autograd.grad(value, x, retain_graph=True)[0] for value in values(x)]
    h = [(values(stored + k * step) - values(stored - k * step)) / (2 * k * step) for k in (1, 2)]
    assert torch.allclose(torch.stack(gradient), (4.0 * h[0] - h[1]) / 3.0, rtol=1e-5)


def test_what_does_not_fit_is_refused(triplet):
    system = triplet.system()
    with pytest.raises(InputError, match="samples"):
        pupil_wavefront(system, AXIS, 500.0, samples=4)
    with pytest.raises(InputError, match="wavelengths"):
        pupil_wavefront(system, AXIS, [500.0, 600.0])
    with pytest.raises(InputError, match="centres"):
        pupil_wavefront(system, AXIS, 500.0, [[0.0, 0.0], [1.0, 0.0]])
    with pytest.raises(InputError, match="radius"):
        pupil_wavefront(system, AXIS, 500.0, radius=0.0)
    with pytest.raises(InputError, match="chief ray"):
        pupil_wavefront(system, ObjectPoints.at_infinity([[0.0, 75.0]]), 500.0)
    with pytest.raises(InputError, match="z < 0"):
        ObjectPoints.at([[0.0, 0.0, 10.0]])
    with pytest.raises(InputError, match="90"):
        ObjectPoints.at_infinity([[0.0, 90.0]])
    with pytest.raises(InputError, match="pairs"):
        ObjectPoints.at_infinity([[0.0, 1.0, 2.0]])
