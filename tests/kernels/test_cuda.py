"""The Triton kernels on a machine without a GPU: interpreted, compiled, and out of the way."""

import os
import re
import subprocess
import sys

import pytest
import torch

from dolens import InputError, Rays, load_lens
from dolens.kernels.surface_kernel import kernels_of
from dolens.kernels.table import Kind
from dolens.optics.ray_tracing import without_triton
from dolens.optics.surfaces import EvenAsphere, XYPolynomial, ZernikeStandard
from tests.kernels.own_surface.paraboloid import Paraboloid

pytest.importorskip("triton")
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
compiled = pytest.mark.skipif(INTERPRETED, reason="the interpreter compiles nothing")


def python(root, *arguments, **environment):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)} | environment,
        capture_output=True,
        text=True,
    )


@compiled
def test_in_tritons_interpreter_the_kernels_are_the_reference(root):
    """Tests in a process where Triton was told before it came up."""
    options = ("-n", "0", "-q", "--tb=short", "-p", "no:cacheprovider")
    files = ("tests/kernels/interpreted_cuda.py", "tests/kernels/interpreted_lenses.py")
    tests = [*files, *options]
    run = python(root, "-m", "pytest", *tests, TRITON_INTERPRET="1", OMP_NUM_THREADS="1")
    assert run.returncode == 0, run.stdout[-20000:] + run.stderr[-5000:]
    assert " passed" in run.stdout


@compiled
def test_rays_on_the_cpu_are_refused(root):
    from dolens.kernels.cuda import backend
    from dolens.optics.packing import pack

    lens = load_lens(root / "conf/lens/asphere.yaml")
    table = pack(lens.system(), 550.0, 1.0, 1, 2, True)
    rays = Rays(torch.zeros(3, 3).double(), torch.eye(3).double())
    with pytest.raises(InputError, match="GPU"):
        backend.trace(table, rays.position, rays.direction, None)
    lens.backend = "cuda"
    with pytest.raises(InputError, match="cuda"):
        lens.trace(rays)


def compile_for(kernel, real, kinds, surfaces, block, absent):
    """PTX of a kernel for an H100 or H200, which need not be here."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from dolens.kernels.cuda.functions import shape_of

    numbers = "*fp64" if real == torch.float64 else "*fp32"
    integers = ("codes", "extras", "which", "entries", "entry_places", "entry_columns",
                "index_rows", "index_columns", "output_rows")  # fmt: skip
    types = dict.fromkeys(integers, "*i32") | {
        "sums": "*fp64", "status": "*i8", "out_status": "*i8", "out_surface": "*i16",
        "out_valid": "*i8",
    }  # fmt: skip
    pointers = ("values", "media", "position", "direction", "out_position", "out_direction",
                "out_path", "of_position", "of_direction", "of_path", "position_gradient",
                "direction_gradient", "scratch", "weights", "index_weights", "out_values",
                "out_jacobian", "rows")  # fmt: skip
    types |= dict.fromkeys(pointers, numbers)
    forms = tuple(
        shape_of(surface.kernel.code, kernels_of(surface.kernel.code, "cuda"))
        for surface in surfaces
    )
    fixed = {"KINDS": kinds, "FORMS": forms, "BLOCK": block, "INDICES": False}
    fixed |= dict.fromkeys(absent)
    fixed = {name: value for name, value in fixed.items() if name in kernel.arg_names}
    signature = {
        name: "constexpr" if name in fixed else types.get(name, "i32") for name in kernel.arg_names
    }
    source = ASTSource(kernel, signature=signature, constexprs=fixed)
    options = {"num_warps": 1, "enable_fp_fusion": True}
    return triton.compile(source, target=GPUTarget("cuda", 90, 32), options=options).asm["ptx"]


SPHERES = 1 << Kind.PLANE | 1 << Kind.SPHERE | 1 << Kind.SENSOR
LENSES = {
    "spheres": (SPHERES, ()),
    "aspheres": (SPHERES, (EvenAsphere,)),
    "posed plates": (SPHERES | 1 << Kind.CHANGE_AXES | 1 << Kind.LENS_AXES, (XYPolynomial,)),
    "a surface of a user's own": (SPHERES, (Paraboloid,)),
    # The bit behind those of the kinds of step: see `dolens.kernels.cuda.layout`.
    "apertures made of figures": (SPHERES | 1 << Kind.BY_SAG, ()),
    "polynomials by recurrence": (SPHERES, (ZernikeStandard,)),
}
# The Jacobian's kernel is made of the same steps: these take half of a second to two.
JACOBIANS = [("spheres", torch.float32), ("aspheres", torch.float64)]


@compiled
@pytest.mark.skipif(without_triton() is not None, reason=str(without_triton()))
@pytest.mark.parametrize(
    "name, real",
    [
        ("spheres", torch.float32),
        ("spheres", torch.float64),
        ("posed plates", torch.float32),
        ("aspheres", torch.float64),
        ("a surface of a user's own", torch.float32),
        ("apertures made of figures", torch.float32),
        ("polynomials by recurrence", torch.float64),
    ],
)
def test_the_kernels_compile_and_keep_their_precision(name, real):
    """Divisions and square roots are rounded to nearest, denormals kept, and constants not widened.

    The interpreter could not tell: it has no types but NumPy's.
    """
    from dolens.kernels.cuda.device_table import ADJOINT_BLOCK, FORWARD_BLOCK, JACOBIAN_BLOCK
    from dolens.kernels.cuda.jacobian import jacobian_kernel
    from dolens.kernels.cuda.trace import adjoint_kernel, forward_kernel

    forward = compile_for(forward_kernel, real, *LENSES[name], FORWARD_BLOCK, ("which",))
    absent = ("which", "of_direction", "of_path")
    adjoint = compile_for(adjoint_kernel, real, *LENSES[name], ADJOINT_BLOCK[real], absent)
    kernels = [forward, adjoint]
    if (name, real) in JACOBIANS:
        kernels.append(compile_for(jacobian_kernel, real, *LENSES[name], JACOBIAN_BLOCK, ()))
    bits = 64 if real == torch.float64 else 32
    for ptx in kernels:
        assert f"div.rn.f{bits}" in ptx and f"sqrt.rn.f{bits}" in ptx
        assert not re.search(r"\b(div|sqrt|rcp|rsqrt)\.(approx|full)|\.ftz", ptx)
        assert not re.search(r"\b(fma|mul|div|sqrt)\S*\.f" + str(96 - bits), ptx)
    # Sums alone are in double precision.
    if real == torch.float32:
        assert not any("f64" in ptx for ptx in kernels if ptx != adjoint)
        assert re.search(r"add\S*\.f64", adjoint)
