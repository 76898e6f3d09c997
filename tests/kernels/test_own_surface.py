"""Kernels of a surface that stands outside this library: they answer to its own reference."""

import copy

import pytest

from dolens import InputError
from dolens.kernels.cpu.compiler import source_of
from dolens.kernels.surface_kernel import SurfaceKernel, kernels_of
from dolens.optics.packing import unsupported
from dolens.optics.surfaces import PackedShape, Shape
from tests.kernels.own_surface.paraboloid import Paraboloid
from tests.kernels.trace_cases import (
    LENSES,
    bundle,
    require_equal,
    traced,
)


@pytest.fixture
def lens(root):
    return LENSES["own_surface"](root)


def test_without_kernels_for_a_device_the_reference_traces(lens, monkeypatch):
    rays = bundle(lens, 3000)  # not so few that they are the reference's anyway
    expected = traced(lens, rays, "reference")
    monkeypatch.setattr(Paraboloid, "kernel", SurfaceKernel(cuda="elsewhere"))
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
    with pytest.raises(InputError, match=r"'paraboloid_sag' take 3 numbers of .* gives 2"):
        lens.trace(bundle(lens, 3000))
    monkeypatch.undo()
    monkeypatch.setattr(Paraboloid, "numbers", classmethod(lambda cls, p: (p["twist"],)))
    with pytest.raises(InputError, match="a layout of 3 parts, where `numbers` gives 1"):
        Paraboloid.packed(dict(lens.surfaces["2"].named_parameters()))


def test_kernels_on_disk_go_by_the_file_of_the_shape_s_functions():
    """Not by that of the loops which they are inlined in, which all such surfaces share."""
    functions = kernels_of(Paraboloid.kernel.code, "cpu").of([], [])
    _, _, part, digest = source_of(functions.sag)
    assert part == "paraboloid_sag"
    assert source_of(functions.forward)[3] != digest
    notebook = Shape("cell", *(compile_in_no_file() for _ in range(3)), layout=())
    with pytest.raises(RuntimeError, match="in no file"):
        source_of(kernels_of(SurfaceKernel(shape=notebook).code, "cpu").of([], []).sag)


def compile_in_no_file():
    """A function as a notebook has it."""
    scope = {}
    exec(compile("def cell(p, x, y): ...", "<cell 1>", "exec"), scope)
    return scope["cell"]
