"""The fused splat: the reference's sums and gradients, the same to the bit every time."""

import pytest
import torch

from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.rendering.psf import axial_point_spread_functions, splat
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)


def points(count, size, dtype=torch.float64):
    generator = torch.Generator().manual_seed(7)
    drawn = torch.rand(3, count, generator=generator, dtype=dtype)
    # Some lie beyond the grid on every side.
    return (size + 6) * drawn[0] - 3, (size + 6) * drawn[1] - 3, drawn[2]


@pytest.mark.parametrize("count", [0, 1, 5000, 70_000])
def test_sums_and_gradients_are_the_reference_s(count):
    size = 21
    given = [t.requires_grad_() for t in points(count, size)]
    generator = torch.Generator().manual_seed(8)
    weight = torch.randn(size, size, generator=generator, dtype=torch.float64)
    expected, found = (splat(*given, size, fused) for fused in (False, True))
    assert torch.allclose(found, expected, rtol=1e-12, atol=1e-12)
    pairs = [torch.autograd.grad((image * weight).sum(), given) for image in (expected, found)]
    for one, two in zip(*pairs, strict=True):
        assert torch.allclose(one, two, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("count", [0, 7, 9000])
def test_many_grids_are_each_their_own(count):
    size, grids = 11, 3
    given = [torch.stack([t + 0.3 * g for g in range(grids)]) for t in points(count, size)]
    for fused in (False, True):
        together = splat(*given, size, fused)
        apart = torch.stack([splat(*(t[g] for t in given), size, fused) for g in range(grids)])
        assert torch.equal(together, apart)
    inputs = [t.requires_grad_() for t in given]
    weight = torch.arange(grids * size * size, dtype=torch.float64).reshape(grids, size, size)
    gradients = [
        torch.autograd.grad((splat(*inputs, size, fused) * weight).sum(), inputs)
        for fused in (False, True)
    ]
    for one, two in zip(*gradients, strict=True):
        assert torch.allclose(one, two, rtol=1e-10, atol=1e-9)


def test_single_precision_sums_err_by_its_rounding():
    given = points(50_000, 15)
    expected = splat(*given, 15)
    found = splat(*(t.float() for t in given), 15, fused=True)
    assert float((found - expected).abs().max()) < 1e-5 * float(expected.max())


def test_threads_change_no_bit():
    given, threads, results = points(100_000, 15, torch.float32), torch.get_num_threads(), []
    try:
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            results.append(splat(*given, 15, fused=True))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_points_that_are_no_numbers_are_left_out():
    nan, inf = float("nan"), float("inf")
    rows = torch.tensor([3.2, nan, 3.0, inf, -inf, 1e30], dtype=torch.float64)
    columns = torch.tensor([4.1, 3.0, nan, 3.0, 3.0, -1e30], dtype=torch.float64)
    image = splat(rows, columns, torch.ones(6, dtype=torch.float64), 9, fused=True)
    assert float(image.sum()) == pytest.approx(1.0, abs=1e-14)


def test_point_spread_functions_are_the_reference_s(wavefront_coding):
    scene, sensor = PlanarScene((8000.0, 4500.0), LINES), Sensor(64, 64, 0.0069)
    weight = torch.randn(33, 33, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    lens, results = wavefront_coding(1.0e-5), []
    for backend in ("reference", "cpu"):
        lens.backend = backend
        x3 = torch.tensor(1.0e-5, dtype=torch.float64, requires_grad=True)
        psf = axial_point_spread_functions(
            lens.with_values({"surfaces.5.x3": x3}), scene, sensor, 33, 24
        )
        results.append((psf, torch.autograd.grad((psf * weight).sum(), x3)[0]))
    (image, slope), (same_image, same_slope) = results
    assert torch.allclose(same_image, image, rtol=1e-10, atol=1e-13)
    assert float(same_slope) == pytest.approx(float(slope), rel=1e-10)


def test_second_derivatives_are_an_error():
    rows = torch.tensor([3.2], dtype=torch.float64, requires_grad=True)
    image = splat(rows, rows, torch.ones_like(rows), 9, fused=True)
    (gradient,) = torch.autograd.grad(image.square().sum(), rows, create_graph=True)
    with pytest.raises(InputError, match="first derivatives only"):
        torch.autograd.grad(gradient.sum(), rows)


def test_the_operator_is_what_pytorch_asks_of_one():
    given = [t.reshape(2, 10).requires_grad_() for t in points(20, 9)]
    tests = ("test_schema", "test_faketensor", "test_autograd_registration")
    torch.library.opcheck(rendering.splat, (*given, 9), test_utils=tests)
