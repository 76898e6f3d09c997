"""The CPU kernels of surfaces given by their sag answer to the reference."""

import pytest
import torch

from dolens import Rays
from dolens.optics.jacobian import ray_jacobian
from tests.kernels.trace_cases import (
    LENSES,
    bundle,
    require_equal,
    require_no_worse,
    returning,
    traced,
)

NAMES = ("even_aspheres", "odd_aspheres", "anamorphic", "cylinders", "zernike", "forbes", "grid")
CASES = pytest.mark.parametrize("name", NAMES)


@CASES
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rays_and_gradients_are_those_of_the_reference(name, sense, root):
    lens = LENSES[name](root)
    rays = bundle(lens) if sense > 0.0 else returning(lens, bundle(lens))
    expected = traced(lens, rays, "reference", sense)
    assert (~expected.valid).sum() > 3, "some rays must fail"
    require_equal(traced(lens, rays, "cpu", sense), expected)


@CASES
def test_single_precision_is_no_worse_than_the_reference(name, root):
    lens = LENSES[name](root)
    rays = bundle(lens, fill=0.9)
    held = Rays(rays.position.float().double(), rays.direction.float().double(), 550.0)
    lens = lens.float().double()
    found = traced(lens, held, "cpu", dtype=torch.float32)
    reference = traced(lens, held, "reference", dtype=torch.float32)
    require_no_worse(found, reference, traced(lens, held, "reference"))


@CASES
def test_its_jacobian_is_that_of_the_reference(name, root):
    lens = LENSES[name](root)
    rays, found = bundle(lens, 40), []
    for backend in ("cpu", "reference"):
        lens.backend = backend
        found.append(ray_jacobian(lens, rays, ["surfaces.*", "thicknesses.1"]))
    assert torch.equal(found[0].valid, found[1].valid)
    size = found[1].derivatives.abs().amax((0, 1) if found[1].derivatives.dim() == 3 else 0)
    error = (found[0].derivatives - found[1].derivatives).abs()
    assert (error <= 1e-10 * (1.0 + size)).all()
