"""A shape's one text: its derivatives are those of its sag, in every precision and backend."""

import inspect

import numpy as np
import pytest
import torch
from numba.core.errors import NumbaError

from dolens.kernels import operations
from dolens.kernels.cpu import compiler, shapes
from dolens.kernels.cpu.layout import COLUMNS, COUNT
from dolens.kernels.shapes import Shape, functions_within
from dolens.optics.surfaces.biconic import BICONIC
from dolens.optics.surfaces.even_asphere import EVEN_ASPHERE
from dolens.optics.surfaces.forbes import Q_BFS, Q_CON
from dolens.optics.surfaces.odd_asphere import ODD_ASPHERE
from dolens.optics.surfaces.toroid import TOROID
from dolens.optics.surfaces.xy_polynomial import XY_POLYNOMIAL
from dolens.optics.surfaces.zernike import ZERNIKE

F64 = torch.float64
# Numbers of each shape, part by part; and its table, where the numbers stand for other terms in
# other surfaces.
SHAPES = {
    EVEN_ASPHERE: (0.04, -0.6, 1e-3, (2e-5, -1e-7, 3e-9, 1e-11)),
    ODD_ASPHERE: (0.04, -0.6, 1e-3, (2e-5, -1e-7, 3e-9, 1e-11), 2e-3, (1e-5, 2e-6, -1e-8, 1e-10)),
    Q_CON: (0.04, -0.6, 7.0, (1e-3, -2e-3, 5e-4, 1e-4)),
    Q_BFS: (0.04, -0.6, 7.0, (1e-3, -2e-3, 5e-4, 1e-4)),
    BICONIC: (0.04, -0.03, -0.6, 0.8),
    TOROID: (0.04, -0.6, 1e-3, (2e-5, -1e-7, 3e-9, 1e-11), -0.05),
    XY_POLYNOMIAL: (0.03, (1e-4, 2e-3, 1e-3, -2e-3)),
    ZERNIKE: (0.04, -0.6, 1e-3, (2e-5,), 7.0, 0.3, -0.2, (0.0, 1e-2, 2e-3, 3e-3, 5e-3, -4e-3)),
}
# There is a b; y²·(x and 1), y, 1.  Terms of (k, m) = (0, 0), (0, 1) and (1, 1).
TABLES = {
    XY_POLYNOMIAL: (1, 1, 2, 0, 2, 0, 1, 0, 0),
    ZERNIKE: (0, 0, 1, 0, 1, 4, 1, 1, 8),
}
DATA = {Q_CON: [2], Q_BFS: [2], ZERNIKE: [4, 5, 6]}
CASES = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)


def built(shape, flat):
    """p of a shape from its numbers, one after the other."""
    numbers, parts = iter(flat), []
    for part in SHAPES[shape]:
        series = isinstance(part, tuple)
        parts.append(tuple(next(numbers) for _ in part) if series else next(numbers))
    return (*parts, TABLES[shape]) if shape in TABLES else tuple(parts)


def numbers_of(shape):
    flat = []
    for part in SHAPES[shape]:
        flat += part if isinstance(part, tuple) else (part,)
    return torch.tensor(flat, dtype=F64)


@pytest.fixture
def points():
    x, y = torch.rand((2, 40), generator=torch.Generator().manual_seed(3), dtype=F64) * 8.0 - 4.0
    return x, y


@CASES
def test_slopes_and_second_derivatives_are_those_of_the_sag(shape, points):
    p = built(shape, numbers_of(shape))
    x, y = (v.requires_grad_() for v in points)
    sag, sx, sy, margin = shape.sag(p, x, y)
    assert bool((margin > 0.0).all())
    hx, hy, *seconds = shape.sag_hessian(p, x, y)
    for slope, own, variable in ((sx, hx, x), (sy, hy, y)):
        (expected,) = torch.autograd.grad(sag.sum(), variable, create_graph=True)
        torch.testing.assert_close(slope, expected, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(own, expected, rtol=1e-12, atol=1e-14)
    wanted = [(sx, x), (sx, y), (sy, y)]
    for own, (slope, variable) in zip(seconds, wanted, strict=True):
        (expected,) = torch.autograd.grad(slope.sum(), variable, retain_graph=True)
        torch.testing.assert_close(own, expected, rtol=1e-11, atol=1e-14)


@CASES
def test_cotangents_of_its_numbers_are_those_of_autograd(shape, points):
    flat = numbers_of(shape).requires_grad_()
    of = torch.randn((3, 40), generator=torch.Generator().manual_seed(4), dtype=F64)
    sag, sx, sy, _ = shape.sag(built(shape, flat), *points)
    (expected,) = torch.autograd.grad((of * torch.stack((sag, sx, sy))).sum(), flat)
    found = {}
    shape.parameters(found, built(shape, flat.detach()), *points, *of)
    assert sorted(found) == list(range(len(flat)))
    total = torch.stack([torch.as_tensor(found[i], dtype=F64).sum() for i in range(len(flat))])
    # A normalisation radius is data, and a decentre.
    expected[DATA.get(shape, [])] = 0.0
    torch.testing.assert_close(total, expected, rtol=1e-11, atol=1e-12)


def kernels_of(shape, count=4):
    row = np.zeros(64, dtype=np.int64)
    row[COUNT] = row[COLUMNS] = count
    table = TABLES.get(shape, ())
    if table:
        series = [len(part) for part in SHAPES[shape] if isinstance(part, tuple)]
        row[COUNT], row[COLUMNS] = series[0], series[-1]
    functions = shapes.kernels(shape).of(row, [len(table), *table])
    return functions.sag, functions.sag_hessian, functions.parameters


@CASES
def test_kernels_of_single_precision_have_no_number_of_double_precision(shape):
    for factory in kernels_of(shape):
        kernel = compiler._made(factory, "float32", compiler.block_signature(shapes.types.float32))
        instructions = kernel.inspect_llvm()
        assert "fpext" not in instructions and "double" not in instructions
        assert "x float>" in instructions, "rays are taken several at a time"


@pytest.mark.parametrize("shape", [EVEN_ASPHERE, Q_CON], ids=lambda shape: shape.name)
def test_rays_are_taken_several_at_a_time_however_many_coefficients_there_are(shape):
    for factory in kernels_of(shape, 40):
        kernel = compiler._made(factory, "float64", compiler.block_signature(shapes.types.float64))
        assert "x double>" in kernel.inspect_llvm()


def test_kernels_on_disk_go_by_the_files_of_all_functions_within():
    files = {inspect.getsourcefile(one) for one in functions_within(ODD_ASPHERE.sag)}
    named = {file.rpartition("/")[2] for file in files}
    assert named == {"odd_asphere.py", "even_asphere.py", "operations.py"}
    sag, hessian, _ = (compiler.source_of(factory) for factory in kernels_of(ODD_ASPHERE))
    assert sag[2] == "odd_asphere_sag" and sag != hessian


def wrong_literal(p, x, y):
    (c,) = p
    s = fma(c, x, 2 * y)
    return s, c, c, c


fma = operations.fma


def test_a_mistake_is_told_by_its_line_in_the_shape_s_own_file():
    shape = Shape("wrong", wrong_literal, wrong_literal, wrong_literal, layout=(None,))
    factory = shapes.kernels(shape).of(np.zeros(64, dtype=np.int64), []).sag
    line = inspect.getsourcelines(wrong_literal)[1] + 2
    with pytest.raises(NumbaError) as raised:
        compiler._made(factory, "float32", compiler.block_signature(shapes.types.float32))
    assert "write 2.0 for 2" in str(raised.value)
    assert f'test_shapes.py", line {line}' in str(raised.value)
