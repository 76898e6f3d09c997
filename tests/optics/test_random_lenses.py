"""What holds of every ray of every lens, on lenses at random; `scripts/fuzz_lenses.py` has more."""

import copy
import math

import pytest
import torch

from dolens import Rays, Status
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.prescriptions import lens_from_prescription
from tests.optics.hard_cases import GLASS, surface
from tests.optics.random_lenses import KINDS, SAG_KINDS, random_lens
from tests.optics.ray_agreement import any_cases, disagreements
from tests.optics.ray_facts import BACKENDS, PRECISIONS, cases, chosen, send, violations
from tests.optics.test_surfaces import require_refraction

EPSILON = torch.finfo(torch.float64).eps
DTYPES = pytest.mark.parametrize("dtype", PRECISIONS, ids=["f32", "f64"])
# Ordinary and wild by turns; each of these broke a rule once.
NUMBERS = [1, 6, 9, 17, 20, 36, 53, 78, 105]


@pytest.mark.parametrize(
    ("number", "kinds"), [*((n, KINDS) for n in NUMBERS), *((n, SAG_KINDS) for n in range(6))]
)
def test_invalid_rays_are_finite_without_gradient_and_backends_agree(number, kinds):
    for _, lens, rays, sense in cases(number // 2, bool(number % 2), 150, kinds):
        for dtype in PRECISIONS:
            found = violations(lens, rays, sense, dtype, ("cpu",))
            broken = {rule for rule in found if "within rounding" not in rule}
            assert not broken, found


@pytest.mark.parametrize("number", [0, 2])
def test_backends_agree_on_any_prescription(number):
    """Values, statuses and gradients; `scripts/fuzz_lenses.py --any` has more."""
    for _, lens, rays, sense in any_cases(number // 2, bool(number % 2), 150):
        for dtype in PRECISIONS:
            found = violations(lens, rays, sense, dtype)
            found += disagreements(lens, rays, sense, dtype)
            broken = {rule for rule in found if "within rounding" not in rule}
            assert not broken, found


@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("backend", BACKENDS)
def test_directions_stay_unit_vectors_and_light_returns_the_way_it_came(backend, number):
    """But where a small shift moves light far: near a tangent rounding has no bound."""
    _, lens, rays, sense = next(cases(number, False, 64))
    hit = send(lens, rays, sense, backend)
    assert ((hit.direction[hit.valid].norm(dim=-1) - 1.0).abs() < 64 * EPSILON).all()
    shifted = Rays(rays.position + 1e-7, rays.direction, rays.wavelength)
    near = send(lens, shifted, sense, backend)
    back = lens.sensor_to_scene(Rays(hit.position, -hit.direction, rays.wavelength))
    # Total reflection and rims can fall either way within rounding; all else must return.
    assert int((hit.valid & ~back.valid).sum()) <= 1
    apart = (near.position - hit.position).norm(dim=-1) + (near.direction - hit.direction).norm(
        dim=-1
    )
    held = hit.valid & back.valid & near.valid & (apart < 1e-5)
    away = back.position - rays.position
    across = away - (away * rays.direction).sum(-1, keepdim=True) * rays.direction
    size = rays.position.norm(dim=-1) + hit.position.norm(dim=-1) + 1.0
    assert (across.norm(dim=-1)[held] < 1e-9 * size[held]).all()
    assert ((back.direction + rays.direction).norm(dim=-1)[held] < 1e-9).all()


@pytest.mark.parametrize("number", range(30))
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rays_that_meet_a_surface_end_on_it_and_obey_snell(number, sense):
    lens, draw = random_lens(number, False, (*KINDS, *SAG_KINDS))
    for shape in lens.surfaces.values():
        x, y = shape.semi_diameter * draw.numbers(2, 64)
        direction = torch.cat((0.4 * draw.normal(2, 64), torch.full((1, 64), sense).double()))
        ray = PlaneRay(x, y, *direction / direction.norm(dim=0))
        require_refraction(shape, ray, sense, 1.0, 1.5168)


def test_a_ray_far_off_a_steep_asphere_has_no_gradient():
    """Its slopes there are finite, and their derivatives are not: one ray of 2000."""
    way, lens, rays, sense = next(cases(595 // 2, True, 2000))
    assert way == "forward"
    found = violations(lens, chosen(rays, torch.arange(1400, 1600)), sense, torch.float32)
    assert not {rule for rule in found if "gradient" in rule}, found


def test_a_ray_where_slopes_overflow_is_missed_and_has_no_gradient():
    """An infinite slope allowed for any residual, so that it counted as met: one ray of 2000."""
    found = [c for c in cases(1703 // 2, True, 2000) if c[0] == "backward"]
    _, lens, rays, sense = found[0]
    broken = violations(lens, chosen(rays, torch.arange(500, 700)), sense, torch.float32)
    assert not {rule for rule in broken if "gradient" in rule}, broken


def asphere(**more):
    """A weak lens in glass whose far sag overflows single precision."""
    back = surface("even_asphere", curvature=0.01, conic=0.0, a20=1e-22, material="air")
    front = surface("plane", semi_diameter=50.0, thickness=5.0)
    return lens_from_prescription(
        {"surfaces": {"1": front, "2": back}, "sensor": {"distance": 20.0}, **more}
    )


@DTYPES
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_sag_that_overflows_far_off_ends_the_ray_only(backend, dtype):
    """At x = 9e3 mm, r²⁰ is 1e79: more than single precision holds."""
    lens = asphere().to(dtype)
    lens.backend = backend
    x = torch.tensor([1.0, 9e3, 40.0, -8e3], dtype=dtype)
    position = torch.stack((x, torch.zeros_like(x), torch.full_like(x, -1.0)), -1)
    position.requires_grad_()
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(4, 3)
    hit = lens.trace(Rays(position, direction))
    assert hit.status[0] == Status.OK
    assert (hit.status[[1, 3]] == Status.MISSED).all()
    outputs = torch.cat((hit.position, hit.direction, hit.path_length[:, None]), 1)
    assert outputs.isfinite().all()
    alone = lens.trace(Rays(position[:1].detach(), direction[:1]))
    names = dict(lens.named_parameters())
    both = [
        torch.autograd.grad(h.position.sum() + h.path_length.sum(), list(names.values()),
                            allow_unused=True)
        for h in (hit, alone)
    ]  # fmt: skip
    for name, found, expected in zip(names, *both, strict=True):
        if expected is not None:
            torch.testing.assert_close(found, expected, msg=name)
    (of_rays,) = torch.autograd.grad(lens.trace(Rays(position, direction)).position.sum(), position)
    assert not of_rays[1:].any()
    assert of_rays.isfinite().all()


@DTYPES
@pytest.mark.parametrize("backend", BACKENDS)
def test_light_along_a_vertex_plane_misses_it(backend, dtype):
    """Nothing can be said of where it would cross; a plane has no other points."""
    lens = lens_from_prescription(
        {"surfaces": {"1": surface("plane", material=GLASS)}, "sensor": {"distance": 5.0}}
    ).to(dtype)
    n = torch.tensor([0.0, 1e-10, 1e-3], dtype=dtype)
    direction = torch.stack(((1.0 - n * n).sqrt(), torch.zeros_like(n), n), -1)
    position = torch.zeros(3, 3, dtype=dtype)
    position[:, 0] = -1.0
    hit = send(lens, Rays(position, direction), 1.0, backend)
    assert [Status(int(s)) for s in hit.status] == [Status.MISSED, Status.MISSED, Status.OK]


@DTYPES
@pytest.mark.parametrize("backend", BACKENDS)
def test_light_across_the_axis_reaches_an_element_that_faces_it(backend, dtype):
    """A ray that never crosses a plane z = const. still meets the surface turned towards it.

    The element's plane x = 1 mm, after a turn of 90° about y, has its axis along +x.  A ray along
    +x from (0, 0.3, 2.5) meets it at (1, 0.3, 2.5).
    """
    lens = lens_from_prescription({
        "surfaces": {"1": surface("plane", material="air")},
        "elements": {"1": {"surfaces": [1, 1], "tilt_y": 90.0, "decenter_x": 1.0}},
        "sensor": {"distance": 5.0},
    }).to(dtype)  # fmt: skip
    lens.backend = backend
    start = torch.tensor([[0.0, 0.3, 2.5]], dtype=dtype, requires_grad=True)
    along = torch.tensor([[1.0, 0.0, 0.0]], dtype=dtype, requires_grad=True)
    hit = lens.trace(Rays(start, along), last=1)
    assert bool(hit.valid)
    expected = torch.tensor([[1.0, 0.3, 2.5]], dtype=dtype)
    torch.testing.assert_close(hit.position, expected, atol=2e-6, rtol=0.0)
    torch.testing.assert_close(hit.path_length, torch.ones(1, dtype=dtype), atol=2e-6, rtol=0.0)
    shift = lens.elements["1"].decenter_x
    gradients = torch.autograd.grad(hit.path_length.sum(), [start, along, shift])
    # The distance to the plane is (1 - x)/l.
    for found, true in zip(gradients, ([[-1.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]], 1.0), strict=True):
        torch.testing.assert_close(found, torch.tensor(true, dtype=dtype), atol=1e-5, rtol=0.0)


def test_a_posed_lens_has_a_jacobian_in_single_precision():
    lens = asphere(elements={"1": {"surfaces": [2, 2], "tilt_x": 1.0, "pivot": [0.0, 0.0, 2.0]}})
    rays = Rays(
        torch.tensor([[1.0, 2.0, -1.0]], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
    )
    lens.backend = "reference"
    expected = ray_jacobian(lens, rays, ["thicknesses.*", "elements.*"]).derivatives
    found = ray_jacobian(
        copy.deepcopy(lens).float(), rays, ["thicknesses.*", "elements.*"]
    ).derivatives
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)


def test_sums_of_squares_beyond_single_precision():
    """∂y/∂a20 is some 1e21 at 10 mm, and its square 1e42."""
    lens = asphere()
    rays = Rays(
        torch.tensor([[9.0, 3.0, -1.0], [0.0, 9.5, -1.0]], dtype=torch.float64),
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(2, 3),
    )
    lens.backend = "cpu"
    expected = normal_equations(lens, rays, ["surfaces.2.*"]).jtj
    assert math.sqrt(float(expected.max())) > 1e19
    found = normal_equations(copy.deepcopy(lens).float(), rays, ["surfaces.2.*"]).jtj
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0)


@DTYPES
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("lens_dtype", PRECISIONS, ids=["lens_f32", "lens_f64"])
def test_rays_with_numbers_that_no_light_has_are_missed_and_spoil_no_gradient(
    backend, dtype, lens_dtype
):
    """0·NaN is NaN: one such ray among 1e6 would make all gradients of the lens NaN."""
    lens = asphere(elements={"1": {"surfaces": [2, 2], "tilt_x": 1.0}}).to(lens_dtype)
    lens.backend = backend
    position = torch.tensor([[1.0, 2.0, -1.0]], dtype=dtype).repeat(10, 1)
    direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=dtype).repeat(10, 1)
    position[1, 0], position[2, 2], position[3, 1] = math.nan, math.inf, -math.inf
    direction[4, 2], direction[5, 0], direction[6] = math.nan, math.inf, 0.0
    # Such a one crosses a plane at once, where it is.
    direction[7, 2], direction[8, 2], direction[9] = math.inf, -math.inf, math.inf
    position.requires_grad_()
    direction.requires_grad_()
    results = []
    for some in (slice(None), slice(0, 1)):
        hit = lens.trace(Rays(position[some], direction[some]))
        outputs = torch.cat((hit.position, hit.direction, hit.path_length[:, None]), 1)
        assert outputs.isfinite().all()
        inputs = [position, direction, *lens.parameters()]
        results.append(torch.autograd.grad(outputs.sum(), inputs, allow_unused=True))
        assert hit.status.tolist() == [Status.OK, *[Status.MISSED] * 9][some]
        given = Rays(position[some].detach(), direction[some].detach())
        jacobian = ray_jacobian(lens, given, ["thicknesses.*"])
        assert jacobian.valid.tolist() == hit.valid.tolist()
    for found, alone in zip(*results, strict=True):
        if alone is not None:
            torch.testing.assert_close(found, alone)
            assert found.isfinite().all()
