"""Kernels of a surface that stands outside this library: they answer to its own reference."""

import copy

import pytest
import torch

from dolens import InputError, Rays
from dolens.kernels.cpu.compiler import source_of
from dolens.kernels.cpu.explicit import given_by_scalars
from dolens.kernels.surface_kernel import SurfaceKernel, kernels_of
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.packing import unsupported
from dolens.optics.surfaces import PackedShape
from tests.kernels.own_surface.paraboloid import Paraboloid
from tests.kernels.own_surface.paraboloid_cpu import paraboloid
from tests.kernels.trace_cases import (
    LENSES,
    bundle,
    require_equal,
    require_no_worse,
    returning,
    traced,
)


@pytest.fixture
def lens(root):
    return LENSES["own_surface"](root)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rays_and_gradients_are_those_of_the_reference(lens, sense):
    rays = bundle(lens) if sense > 0.0 else returning(lens, bundle(lens))
    expected = traced(lens, rays, "reference", sense)
    assert (~expected.valid).sum() > 3, "some rays must fail"
    require_equal(traced(lens, rays, "cpu", sense), expected)


def test_single_precision_is_no_worse_than_the_reference(lens):
    rays = bundle(lens, fill=0.9)
    held = Rays(rays.position.float().double(), rays.direction.float().double(), 550.0)
    lens = lens.float().double()
    found = traced(lens, held, "cpu", dtype=torch.float32)
    reference = traced(lens, held, "reference", dtype=torch.float32)
    require_no_worse(found, reference, traced(lens, held, "reference"))


def test_its_jacobian_is_that_of_the_reference(lens):
    names, rays = ["surfaces.2.*", "thicknesses.1"], bundle(lens)
    found = []
    for backend in ("cpu", "reference"):
        lens.backend = backend
        found.append(ray_jacobian(lens, rays, names))
    assert found[0].columns.keys() >= {"surfaces.2.twist"}
    assert torch.equal(found[0].valid, found[1].valid)
    assert (found[0].derivatives - found[1].derivatives).abs().max() < 1e-11


def test_without_kernels_for_a_device_the_reference_traces(lens, monkeypatch):
    rays = bundle(lens, 3000)  # not so few that they are the reference's anyway
    expected = traced(lens, rays, "reference")
    monkeypatch.setattr(Paraboloid, "kernel", SurfaceKernel(cuda=Paraboloid.kernel.cuda))
    assert unsupported(lens.system()) == "surface 2 (paraboloid) has no kernel for cpu"
    require_equal(traced(lens, rays, "auto"), expected, length=1e-15, relative=1e-15)
    with pytest.raises(InputError, match=r"surface 2 \(paraboloid\) has no kernel for cpu"):
        traced(lens, bundle(lens), "cpu")


@pytest.mark.parametrize(
    "module, wrong",
    [("tests.kernels.no_such", "no module named"), ("tests.kernels.trace_cases", "offers no KERN")],
)
def test_a_module_that_is_not_there_or_has_no_kernels_is_named(lens, monkeypatch, module, wrong):
    monkeypatch.setattr(Paraboloid, "kernel", SurfaceKernel(cpu=module))
    with pytest.raises(InputError, match=wrong):
        copy.deepcopy(lens).trace(bundle(lens, 3000))  # not so few that PyTorch takes them


def test_kernels_that_take_other_numbers_than_the_surface_has_are_refused(lens, monkeypatch):
    two = classmethod(lambda cls, p: PackedShape((p["curvature_x"], p["curvature_y"])))
    monkeypatch.setattr(Paraboloid, "packed", two)
    with pytest.raises(InputError, match=r"'paraboloid' take 3 numbers of a surface; .* gives 2"):
        lens.trace(bundle(lens, 3000))


def test_kernels_on_disk_go_by_the_file_of_the_scalar_functions(tmp_path):
    """Not by that of the loops which they are inlined in, which all such surfaces share."""
    functions = kernels_of(Paraboloid.kernel.code, "cpu")
    module, name, part, digest = source_of(functions.sag)
    assert (module, name, part) == (paraboloid.__module__, "paraboloid", "paraboloid_sag")
    assert source_of(functions.sag_hessian)[3] == digest
    assert source_of(functions.forward)[3] != digest
    notebook = compile_in_no_file()
    with pytest.raises(RuntimeError, match="in no file"):
        source_of(given_by_scalars(notebook, numbers=1).sag)


def compile_in_no_file():
    """A function as a notebook has it."""
    scope = {}
    exec(compile("def cell(real): ...", "<cell 1>", "exec"), scope)
    return scope["cell"]


def test_a_shape_without_numbers_is_refused():
    with pytest.raises(InputError, match="1 or more"):
        given_by_scalars(paraboloid, numbers=0)
