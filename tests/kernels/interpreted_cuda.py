"""The Triton kernels in Triton's interpreter, on the CPU: run by `test_cuda.py`, which sets it up.

`TRITON_INTERPRET=1 python -m pytest tests/kernels/interpreted_cuda.py` runs it alone.
"""

import pytest
import torch
import triton.language as tl
from triton.runtime import interpreter

from dolens import Rays
from dolens.kernels import operators
from dolens.kernels.cuda import backend as cuda
from dolens.kernels.cuda import device_table
from dolens.optics import ray_tracing
from tests.kernels.trace_cases import (
    LENSES,
    bundle,
    require_equal,
    require_no_worse,
    returning,
    traced,
)

# Every kind of surface; some of them backward too, where no code of its own is left to try.  The
# Nikon lens, of spheres and even aspheres, has no kind of its own, and takes longest.
CASES = [(name, 1.0) for name in LENSES if name != "nikon"] + [
    (name, -1.0) for name in ("posed", "polynomial", "clipped", "figures", "mirrors", "folded")
]
SINGLE = ["cooke_triplet", "polynomial", "even_aspheres"]


@pytest.fixture(autouse=True)
def one_block(monkeypatch):
    """The interpreter takes its time for every block, however large."""
    monkeypatch.setattr(device_table, "FORWARD_BLOCK", 128)
    monkeypatch.setattr(device_table, "JACOBIAN_BLOCK", 128)
    monkeypatch.setattr(
        device_table, "ADJOINT_BLOCK", dict.fromkeys(device_table.ADJOINT_BLOCK, 128)
    )


@pytest.fixture(autouse=True)
def adapted_once(monkeypatch):
    """The interpreter adapts Triton's language for a kernel, and once more for each call of a
    function within it, which takes half of its time.
    """
    adapt, adapted = interpreter._patch_lang, set()

    def once(function):
        languages = {id(v) for v in function.__globals__.values() if v is tl or v is tl.core}
        if languages <= adapted:
            return None
        scope = adapt(function)
        adapted.update(languages)
        if scope is not None:  # which Triton undoes behind the kernel
            undo = scope.restore
            scope.restore = lambda: (undo(), adapted.clear())
        return scope

    monkeypatch.setattr(interpreter, "_patch_lang", once)


@pytest.fixture
def triplet(root):
    return LENSES["cooke_triplet"](root)


def interpreted(*args, **options):
    """Trace as `backend: cpu` would, with the Triton kernels in its place."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(operators, "kernels_of", lambda position: cuda)
        # By the operator, as on a GPU.
        patch.setattr(ray_tracing, "traces_eagerly", lambda *_: False)
        return traced(*args, backend="cpu", **options)


@pytest.mark.parametrize("name, sense", CASES)
def test_rays_and_gradients_are_those_of_the_reference(name, sense, root):
    lens = LENSES[name](root)
    rays = bundle(lens)
    if sense < 0.0:
        rays = returning(lens, rays)
    found = interpreted(lens, rays, sense=sense)
    expected = traced(lens, rays, "reference", sense)
    assert (~expected.valid).sum() > 3, "some rays must fail"
    require_equal(found, expected)
    assert all(torch.isfinite(v).all() for v in (found.position, found.direction, found.path))
    failed = ~expected.valid
    assert not found.gradients["position"][failed].any()
    assert not found.gradients["direction"][failed].any()


@pytest.mark.parametrize("name", SINGLE)
def test_single_precision_is_no_worse_than_the_reference(name, root):
    lens = LENSES[name](root)
    rays = bundle(lens, fill=0.9)
    # All from the numbers that single precision holds.
    held = Rays(rays.position.float().double(), rays.direction.float().double(), 550.0)
    lens = lens.float().double()
    found = interpreted(lens, held, dtype=torch.float32)
    reference = traced(lens, held, "reference", dtype=torch.float32)
    require_no_worse(found, reference, traced(lens, held, "reference"))


def test_every_ray_may_have_its_own_wavelength(root):
    lens = LENSES["wavefront_coding"](root)
    colours = [[486.1327], [587.5618], [656.2725]]
    rays = bundle(lens, 40, wavelengths=colours)
    require_equal(interpreted(lens, rays), traced(lens, rays, "reference"))


def test_gradients_of_the_indices_are_those_of_the_cpu_kernels(triplet):
    """No parameter of a lens moves an index, so the operator is asked itself."""
    from dolens.optics.packing import pack

    colours = torch.tensor([486.1327, 587.5618, 656.2725], dtype=torch.float64)
    table = pack(triplet.system(), colours, 1.0, 1, len(triplet.surfaces), True)
    rays = bundle(triplet, 90)
    which = (torch.arange(90) % 3).to(torch.int32)
    found = []
    for columns in (which, None):
        for backend in (None, cuda):
            indices = table.indices.clone().requires_grad_()
            with pytest.MonkeyPatch.context() as patch:
                if backend is not None:
                    patch.setattr(operators, "kernels_of", lambda position: cuda)
                out = operators.trace(
                    table.values.detach(), indices[:, :1] if columns is None else indices,
                    rays.position, rays.direction, columns, table.codes, table.extras,
                )  # fmt: skip
                ok = out[3] == 0
                total = out[0][ok].square().sum() + 0.01 * out[2][ok].square().sum()
                found.append(torch.autograd.grad(total, indices)[0])
    for cpu, triton in (found[:2], found[2:]):
        assert cpu.abs().max() > 0.0
        assert (cpu - triton).abs().max() <= 1e-11 * cpu.abs().max()


def test_a_broken_ray_spoils_no_other(root):
    """All else is as if those rays passed the lens by."""
    lens = LENSES["posed"](root)
    broken = torch.zeros(40, dtype=torch.bool)
    broken[[3, 5, 8, 11, 12]] = True
    rays = bundle(lens, 40)
    passing = rays.position.clone()
    passing[broken, 0] = 900.0
    rays = Rays(passing, rays.direction, 550.0)
    position, direction = passing.clone(), rays.direction.clone()
    position[3, 0], position[5, 2], position[8] = float("nan"), float("inf"), 1e300
    direction[11, 1], direction[12, 2] = float("nan"), float("inf")
    spoilt = Rays(position, direction, 550.0)
    found, expected = interpreted(lens, spoilt), interpreted(lens, rays)
    assert not found.valid[broken].any()
    for name in ("position", "direction", "path", "status", "surface"):
        assert torch.equal(getattr(found, name)[~broken], getattr(expected, name)[~broken]), name
    found.gradients["direction"][broken] = 0.0
    for name, gradient in expected.gradients.items():
        assert torch.equal(found.gradients[name], gradient), name
    assert torch.equal(found.status, traced(lens, spoilt, "reference").status)


def test_programs_that_take_several_blocks_in_turn_sum_the_same(root, monkeypatch):
    lens = LENSES["clipped"](root)
    rays = bundle(lens, 70)
    alone = interpreted(lens, rays)
    monkeypatch.setattr(device_table, "FORWARD_BLOCK", 64)
    monkeypatch.setattr(
        device_table, "ADJOINT_BLOCK", dict.fromkeys(device_table.ADJOINT_BLOCK, 32)
    )
    monkeypatch.setattr(device_table, "ADJOINT_PROGRAMS", 2)
    shared, again = interpreted(lens, rays), interpreted(lens, rays)
    require_equal(shared, alone, relative=1e-13)
    assert all(torch.equal(shared.gradients[k], again.gradients[k]) for k in shared.gradients)


def test_rays_of_any_strides(root):
    lens = LENSES["clipped"](root)
    rays = bundle(lens)
    turned = Rays(rays.position.T.contiguous().T, rays.direction.T.contiguous().T, 550.0)
    require_equal(interpreted(lens, turned), interpreted(lens, rays), relative=1e-13)


def test_no_rays_at_all(triplet):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(operators, "kernels_of", lambda position: cuda)
        position = torch.zeros((0, 3), dtype=torch.float64, requires_grad=True)
        triplet.backend = "cpu"
        hit = triplet.trace(Rays(position, torch.zeros((0, 3), dtype=torch.float64), 550.0))
        hit.position.sum().backward()
    assert position.grad.shape == (0, 3)
