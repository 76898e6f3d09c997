"""The Triton kernels of many lenses in Triton's interpreter, on the CPU: run by `test_cuda.py`.

`TRITON_INTERPRET=1 python -m pytest tests/kernels/interpreted_lenses.py` runs it alone.
"""

import pytest
import torch
from torch.func import jacfwd, vmap

from dolens import Rays
from dolens.kernels.cpu import lenses as cpu
from dolens.kernels.cuda import lenses as cuda
from dolens.kernels.table import MapOfLenses
from dolens.optics import lens_family
from dolens.optics.lens_family import FamilyRays, LensFamily
from dolens.optics.ray_tracing import trace_rays
from dolens.prescriptions import lens_from_prescription
from tests.kernels.interpreted_cuda import adapted_once, one_block  # noqa: F401  fixtures

WAVELENGTHS = (486.1327, 656.2725)
NAMES = ["surfaces.*.curvature", "surfaces.2.a4", "thicknesses.*", "sensor_distance"]
LENSES, RAYS = 2, 12
EXACT = {"rtol": 1e-12, "atol": 1e-12}


def family_of(dtype=torch.float64):
    """A singlet of a sphere and an asphere, through which some of the rays do not pass."""
    surfaces = {
        "1": {"radius": 40.0, "semi_diameter": 5.0, "thickness": 3.0, "material": "1.5168/64.17"},
        "2": {"type": "even_asphere", "radius": -60.0, "conic": 0.4, "a4": 1e-5,
              "semi_diameter": 4.6, "material": "air"},
    }  # fmt: skip
    lens = lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 40.0}})
    return LensFamily(lens.to(dtype), NAMES, WAVELENGTHS)


@pytest.fixture(scope="module")
def family():
    return family_of()


@pytest.fixture(scope="module")
def values(family):
    generator = torch.Generator().manual_seed(1)
    off = torch.randn(LENSES, family.count, generator=generator, dtype=torch.float64)
    return family.start * (1.0 + 0.01 * off)


@pytest.fixture(scope="module")
def rays():
    generator = torch.Generator().manual_seed(2)
    position = 2.5 * torch.randn(LENSES, RAYS, 3, generator=generator, dtype=torch.float64)
    position[..., 2] = -1.0
    direction = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(LENSES, RAYS, 3)
    return FamilyRays(position, direction, (torch.arange(RAYS) % 2).int())


@pytest.fixture
def on_gpu(monkeypatch):
    """The family takes the kernels of a GPU."""

    def switch(kernels):
        monkeypatch.setattr(lens_family, "kernels_of_lenses", lambda position: kernels)

    switch(cuda)
    return switch


def traced(family, values, rays):
    leaf = values.clone().requires_grad_()
    indices = family.table(values).indices.clone().requires_grad_()
    position = rays.position.clone().requires_grad_()
    hit = family.trace(leaf, FamilyRays(position, rays.direction, rays.wavelength), indices)
    total = hit.position[hit.valid].square().sum() + hit.path_length[hit.valid].sum()
    total = total + hit.direction[hit.valid][..., 1].sum()
    return hit, torch.autograd.grad(total, (leaf, indices, position))


def test_rays_and_gradients_are_those_of_the_cpu_kernels(family, values, rays, on_gpu):
    hit, gradients = traced(family, values, rays)
    on_gpu(cpu)
    expected, of_cpu = traced(family, values, rays)
    assert torch.equal(hit.status, expected.status)
    assert torch.equal(hit.surface, expected.surface)
    assert 0 < int(hit.valid.sum()) < LENSES * RAYS
    valid = hit.valid
    torch.testing.assert_close(hit.position[valid], expected.position[valid], **EXACT)
    torch.testing.assert_close(hit.path_length[valid], expected.path_length[valid], **EXACT)
    for found, wanted in zip(gradients, of_cpu, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12 * wanted.abs().max())


def test_jacobians_are_those_of_the_cpu_kernels_and_of_vmap(family, values, rays, on_gpu):
    outputs = ("y", "path_length", "m")
    rows = torch.tensor([1])
    slope = torch.tensor([[[0.7, 1.6]], [[0.8, 1.5]]], dtype=torch.float64)
    own = family.with_indices(rows, torch.tensor([family.count]), family.count + 1)
    variables = MapOfLenses(own, index_derivatives=slope)
    found = family.jacobians(values, rays, outputs, variables=variables)
    on_gpu(cpu)
    expected = family.jacobians(values, rays, outputs, variables=variables)
    assert torch.equal(found.valid, expected.valid)
    torch.testing.assert_close(found.values, expected.values, **EXACT)
    scale = expected.derivatives.abs().amax((1, 3), keepdim=True)
    torch.testing.assert_close(
        found.derivatives / scale, expected.derivatives / scale, rtol=0.0, atol=1e-12
    )
    assert found.derivatives[:, :, -1].abs().max() > 0.0
    lens, waves = family.lens, torch.tensor(WAVELENGTHS, dtype=torch.float64)

    def y_of(row, position):
        parts = {
            name: row[where].reshape(lens.variables([name])[name].shape)
            for name, where in family.columns.items()
        }
        bundle = Rays(position, rays.direction[0], waves[rays.wavelength.long()])
        return trace_rays(lens.system(parts).traced_by("reference"), bundle).position[:, 1]

    reference = vmap(jacfwd(y_of))(values, rays.position).mT
    reference = torch.where(found.valid[:, None], reference, 0.0)
    torch.testing.assert_close(
        found.derivatives[:, 0, :-1] / scale[:, 0, :-1], reference / scale[:, 0, :-1],
        rtol=0.0, atol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize(("dtype", "error"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_normal_equations_are_those_of_the_cpu_kernels(values, rays, on_gpu, dtype, error):
    family = family_of(dtype)
    given = FamilyRays(rays.position.to(dtype), rays.direction.to(dtype), rays.wavelength)
    target = torch.tensor([0.1, 3.0], dtype=dtype).expand(LENSES, RAYS, 2)
    weight = torch.linspace(0.5, 1.5, RAYS, dtype=dtype).expand(LENSES, RAYS)
    asked = (values.to(dtype), given, target, weight, torch.arange(RAYS) // 5, 3)
    found = family.normal_equations(*asked)
    on_gpu(cpu)
    expected = family.normal_equations(*asked)
    for name, wanted in vars(expected).items():
        torch.testing.assert_close(
            getattr(found, name), wanted, rtol=0.0, atol=error * wanted.abs().max(), msg=name
        )


def test_lenses_and_rays_by_parts_sum_to_the_same(family, values, rays, on_gpu, monkeypatch):
    """As where a Jacobian of all of them would take too much memory."""
    few = FamilyRays(rays.position[:, :4], rays.direction[:, :4], rays.wavelength[:4])
    target = torch.zeros((LENSES, 4, 2), dtype=torch.float64)
    whole = family.normal_equations(values, few, target)
    monkeypatch.setattr(cuda, "_NUMBERS", 2 * family.count * 3)
    parts = family.normal_equations(values, few, target)
    torch.testing.assert_close(parts.jtj, whole.jtj, rtol=1e-13, atol=1e-13)
    assert torch.equal(parts.count, whole.count)
