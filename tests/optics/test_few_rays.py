"""A few rays never wait for a compiler, and nothing of that shows in their last digits."""

import pytest
import torch

import dolens
from dolens.optics.ray_tracing import FEW, is_few


@pytest.fixture
def lens(root):
    return dolens.load_lens(root / "conf/lens/cooke_triplet.yaml", torch.float64)


def rays(count):
    position = torch.zeros(count, 3, dtype=torch.float64)
    position[:, 0], position[:, 2] = torch.linspace(-4.0, 4.0, count), -1.0
    return dolens.Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 550.0)


def test_few_is_a_number_of_rays_and_surfaces_and_of_nothing_else(lens):
    few = FEW // len(lens.surfaces)
    assert is_few(lens.system(), rays(few)) and not is_few(lens.system(), rays(few + 1))
    colours = torch.full((8, 1), 550.0)
    many = dolens.Rays(rays(few).position, rays(few).direction, colours)
    assert not is_few(lens.system(), many)  # few rays, in eight colours each
    none = dolens.Rays(torch.zeros(0, 3), torch.tensor([0.0, 0.0, 1.0]))
    assert is_few(lens.system(), none)
    for backend in ("cpu", "reference"):
        lens.backend = backend
        assert not is_few(lens.system(), rays(5))  # who names a backend gets it


def test_few_rays_are_traced_as_by_the_reference_and_agree_with_the_kernels(lens):
    given = rays(50)
    found = {}
    for backend in ("auto", "reference", "cpu"):
        lens.backend = backend
        found[backend] = lens.trace(given).position
    assert torch.equal(found["auto"], found["reference"])
    assert (found["auto"] - found["cpu"]).abs().max() < 1e-13  # mm
    # The kernels have been used by now, and few rays are still traced as before.
    lens.backend = "auto"
    assert torch.equal(lens.trace(given).position, found["reference"])
