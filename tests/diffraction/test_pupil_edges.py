"""Shares of cells that apertures pass."""

import math

import pytest
import torch

from dolens.diffraction.wavefront import coverage
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Rectangle, Unlimited


def grid(samples: int, offset: tuple[float, float] = (0.0, 0.0)) -> tuple[torch.Tensor, ...]:
    """x and y of cells of a square of half-width 1.2 about an offset, and a cell's area."""
    axis = ((torch.arange(samples).double() + 0.5) * 2.0 / samples - 1.0) * 1.2
    y, x = torch.meshgrid(axis + offset[1], axis + offset[0], indexing="ij")
    return x, y, (2.4 / samples) ** 2


@pytest.mark.parametrize(
    "aperture, area",
    [
        (ClearAperture(Circle(1.0)), math.pi),
        (ClearAperture(Circle(1.0), Circle(0.35)), math.pi * (1.0 - 0.35**2)),
        # A cell at a corner has one edge only.
        (ClearAperture(Rectangle(0.9, 0.55)), 4.0 * 0.9 * 0.55),
    ],
    ids=["circle", "ring", "rectangle"],
)
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.013, -0.031)])
def test_shares_add_up_to_the_area(aperture, area, offset):
    x, y, cell = grid(40, offset)
    share = coverage(aperture, x, y)
    assert float(share.min()) == 0.0 and float(share.max()) == 1.0
    assert float(share.sum() * cell) == pytest.approx(area, rel=6e-4)


def test_every_cell_s_share_is_its_own():
    samples, fine = 24, 64
    x, y, _ = grid(samples, (0.02, 0.007))
    found = coverage(ClearAperture(Circle(1.0)), x, y)
    x, y, _ = grid(samples * fine, (0.02, 0.007))
    inside = (x * x + y * y < 1.0).double()
    counted = inside.reshape(samples, fine, samples, fine).mean((1, 3))
    assert float((found - counted).abs().max()) < 0.01
    assert int(((counted > 0.05) & (counted < 0.95)).sum()) > 40


def test_the_derivative_is_that_of_the_area():
    """Of a circle that grows, 2πr; of one that moves, nothing."""
    x, y, cell = grid(40, (0.004, 0.011))
    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    area = cell * coverage(ClearAperture(Circle(1.0)), x / scale + shift, y / scale).sum()
    growth, moved = torch.autograd.grad(area, (scale, shift))
    assert float(growth) == pytest.approx(2.0 * math.pi, rel=2e-3)
    assert abs(float(moved)) < 1e-2


def test_an_unlimited_surface_passes_all():
    x, y, _ = grid(8)
    assert bool((coverage(ClearAperture(Unlimited(0.1)), x, y) == 1.0).all())
