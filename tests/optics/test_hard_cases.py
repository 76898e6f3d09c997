"""Hard cases of geometrical optics: value, validity and gradient against 80 digits."""

import pytest
import torch

from dolens import Rays, Status
from dolens.prescriptions import lens_from_prescription
from tests.optics import exact
from tests.optics.hard_case_errors import WAVELENGTH, measure, traced
from tests.optics.hard_cases import AXIAL, CASES, from_points, singlet

both = pytest.mark.usefixtures("backend")

STATUS = {"missed": Status.MISSED, "vignetted": Status.VIGNETTED, "tir": Status.TIR}
DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
PASSING = [name for name, case in CASES.items() if case.rays]
ENDING = [name for name, case in CASES.items() if case.ends]


@DTYPES
@pytest.mark.parametrize("name", PASSING)
def test_no_error_exceeds_a_few_roundings_of_the_inputs(name, dtype):
    """What 16 roundings of all inputs would do to the value is allowed, and 64 to a gradient.

    Both are estimated by random perturbations of the prescription and the ray, in 80 digits.
    """
    for backend in ("reference", "cpu"):  # in one process, which keeps the digits of the first
        errors = measure(CASES[name], dtype, backend)
        assert errors.value_roundings < 16.0, (backend, errors)
        assert errors.gradient_roundings < 64.0, (backend, errors)


@both
@DTYPES
@pytest.mark.parametrize("name", ENDING)
def test_rays_that_end_say_where_and_why_and_poison_nothing(name, dtype):
    case = CASES[name]
    lens = lens_from_prescription(case.prescription(), dtype)
    for origin, direction, status, number in case.ends:
        _, _, hit = traced(lens, origin, direction, dtype)
        found = (Status(int(hit.status)).name.lower(), int(hit.surface), bool(hit.valid))
        assert found == (status, number, False)
        ray = [[exact.mp.mpf(v) for v in vector] for vector in (origin, direction)]
        assert exact.trace(lens, exact.values_of(lens), *ray, WAVELENGTH)[:2] == (
            int(hit.status),
            number,
        )
        for output in (hit.position, hit.direction, hit.path_length):
            assert output.isfinite().all()
        total = hit.position.sum() + hit.direction.sum() + hit.path_length
        for gradient in torch.autograd.grad(total, list(lens.parameters()), allow_unused=True):
            assert gradient is None or torch.equal(gradient, torch.zeros_like(gradient))


@both
@pytest.mark.parametrize("distance, error", [(1e4, 2e-6), (1e7, 2e-6)])
def test_a_double_precision_source_far_from_a_float32_lens(distance, error):
    """22 µm is what a solution from the far origin itself costs in float32 at 10 m."""
    prescription = {"surfaces": {str(i): s for i, s in enumerate(singlet(), 1)},
                    "sensor": {"distance": 28.0}}  # fmt: skip
    source = (0.03 * distance, -0.02 * distance, -distance)
    [(origin, direction)] = from_points(source)
    rays = Rays(*(torch.tensor(v, dtype=torch.float64) for v in (origin, direction)), WAVELENGTH)
    exact = lens_from_prescription(prescription, torch.float64).trace(rays)
    single = lens_from_prescription(prescription, torch.float32).trace(rays)
    assert single.position.dtype == torch.float32
    assert (single.position.double() - exact.position)[:2].abs().max() < error
    relative = (single.path_length.double() - exact.path_length) / exact.path_length
    assert abs(float(relative.detach())) < 1e-7


@both
def test_a_trace_changes_no_tensor_of_its_caller():
    lens = lens_from_prescription(CASES["elements tilted by 30°"].prescription())
    position = torch.tensor([[1.0, -2.0, -30.0], [0.0, 50.0, -8.0]], dtype=torch.float64)
    direction = torch.tensor([[0.0, 0.1, 0.9], [0.0, 0.0, 1.0]], dtype=torch.float64)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    wavelength = torch.tensor([500.0, 600.0], dtype=torch.float64)
    kept = [t.clone() for t in (position, direction, wavelength, *lens.parameters())]
    lens.trace(Rays(position, direction, wavelength), record=True)
    lens.sensor_to_scene(Rays(position, -direction, wavelength), record=True)
    now = (position, direction, wavelength, *lens.parameters())
    for before, after in zip(kept, now, strict=True):
        assert torch.equal(before, after)


@both
def test_strided_and_expanded_rays_are_traced_as_contiguous_ones():
    lens = lens_from_prescription(CASES["object at 1 m"].prescription())
    generator = torch.Generator().manual_seed(0)
    wide = torch.rand((5, 4, 6), generator=generator, dtype=torch.float64) * 2.0 - 1.0
    position = wide[:, ::2, ::2].transpose(0, 1)  # (2, 5, 3), no two elements adjacent
    direction = torch.tensor(AXIAL, dtype=torch.float64).expand(2, 5, 3)
    wavelength = torch.tensor([480.0, 640.0], dtype=torch.float64)[:, None].expand(2, 5)
    found = lens.trace(Rays(position, direction, wavelength))
    packed = (t.contiguous() for t in (position, direction, wavelength))
    expected = lens.trace(Rays(*packed))
    assert torch.equal(found.position, expected.position)
    assert not torch.equal(found.position[0], found.position[1])


@both
def test_nothing_is_cached_that_a_change_of_the_lens_makes_stale():
    lens = lens_from_prescription(CASES["object at 1 m"].prescription())
    fresh = lens_from_prescription(CASES["object at 1 m"].prescription())
    axis = Rays(torch.tensor([1.0, 0.0, -5.0]).double(), torch.tensor(AXIAL).double())
    before = float(lens.first_order().efl.detach()), lens.trace(axis).position
    with torch.no_grad():
        lens.surfaces["1"].curvature += 0.01
        fresh.load_state_dict(lens.state_dict())
    after = float(lens.first_order().efl.detach()), lens.trace(axis).position
    assert after[0] == float(fresh.first_order().efl.detach()) != before[0]
    assert torch.equal(after[1], fresh.trace(axis).position)
    assert not torch.equal(after[1], before[1])


@both
@pytest.mark.parametrize("first, last", [(1, 2), (2, 3), (3, 4), (2, 2)])
def test_a_sub_range_continues_where_the_whole_trace_stands(first, last):
    lens = lens_from_prescription(CASES["elements tilted by 30°"].prescription())
    rays = Rays(torch.tensor([1.0, -2.0, -30.0]).double(), torch.tensor(AXIAL).double())
    whole = lens.trace(rays, record=True)
    start = rays
    if first > 1:
        before = lens.trace(rays, last=first - 1)
        start = Rays(before.position, before.direction, rays.wavelength)
    part = lens.trace(start, record=True, first=first, last=last)
    assert torch.allclose(part.points, whole.points[first - 1 : last], rtol=0.0, atol=1e-13)
    assert torch.equal(part.position, part.points[-1])
    back = lens.sensor_to_scene(
        Rays(part.position, -part.direction, rays.wavelength), first=first, last=last
    )
    assert torch.allclose(back.position, whole.points[first - 1], rtol=0.0, atol=1e-12)


@both
def test_wavelengths_are_one_more_batch_dimension():
    lens = lens_from_prescription(CASES["object at 1 m"].prescription())
    position = torch.tensor([[0.0, 1.0, -3.0], [2.0, 0.0, -3.0]], dtype=torch.float64)
    direction = torch.tensor(AXIAL, dtype=torch.float64)
    lines = torch.tensor([486.1327, 587.5618, 656.2725], dtype=torch.float64)
    together = lens.trace(Rays(position, direction, lines[:, None]), record=True)
    assert together.position.shape == (3, 2, 3)
    assert together.points.shape == (2, 3, 2, 3)
    for line, found in zip(lines, together.position, strict=True):
        alone = lens.trace(Rays(position, direction, float(line))).position
        assert torch.allclose(found, alone, rtol=1e-14, atol=1e-14)
    assert (together.position[0] - together.position[2]).abs().max() > 0.01
