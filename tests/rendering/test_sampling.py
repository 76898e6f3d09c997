"""Samples of squares and discs."""

import math

import pytest
import torch

from dolens.rendering.sampling import square_to_disc, stratified_square


def jitter(count: int, cells: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, count, cells, dtype=torch.float64, generator=generator)


def test_every_cell_of_every_sampling_holds_one_point():
    u, v = stratified_square(7, *jitter(100, 49, seed=3))
    cell = (u * 7).floor() + 7 * (v * 7).floor()
    assert torch.equal(cell.sort(dim=1).values, torch.arange(49.0).double().expand(100, 49))


def test_the_disc_map_preserves_area():
    # A uniform square has r² uniform on [0, 1] and the angle uniform.
    u, v = stratified_square(100, *jitter(60, 10_000, seed=0))
    x, y = square_to_disc(u, v)
    r2 = x * x + y * y
    assert float(r2.max()) <= 1.0
    for level in (0.1, 0.25, 0.5, 0.9):
        assert float((r2 < level).double().mean()) == pytest.approx(level, abs=2e-3)
    sector = (torch.atan2(y, x) + math.pi) / (2 * math.pi)
    for level in (0.2, 0.55, 0.8):
        assert float((sector < level).double().mean()) == pytest.approx(level, abs=2e-3)


def test_the_centre_of_the_square_is_the_centre_of_the_disc():
    half = torch.tensor([0.5], dtype=torch.float64)
    x, y = square_to_disc(half, half)
    assert float(x) == 0.0 and float(y) == 0.0
