"""The modulation transfer of points, as mathematics."""

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy.special import j1
from torch.autograd import gradcheck, gradgradcheck

from dolens.analysis.modulation_transfer import diffraction_limited_transfer, modulation_transfer
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.errors import InputError


@pytest.fixture
def spots():
    generator = torch.Generator().manual_seed(1)
    points = 0.02 * torch.randn(3, 12, 2, generator=generator, dtype=torch.float64)
    weights = torch.rand(12, generator=generator, dtype=torch.float64)
    return points, weights


def test_a_uniform_disc_has_that_of_its_bessel_function():
    points, weights = uniform_pupil_points(20000)
    frequency = torch.linspace(0.5, 30.0, 60, dtype=torch.float64)
    x = 2.0 * math.pi * 0.05 * frequency.numpy()
    for direction in ("sagittal", "tangential"):
        found = modulation_transfer(0.05 * points, weights, frequency, direction)
        np.testing.assert_allclose(found, np.abs(2.0 * j1(x) / x), atol=2e-3)


def test_two_points_beat():
    """|cos(π·ν·d)|, and no contrast is lost across them."""
    points = torch.tensor([[0.0, 0.1], [0.0, 0.3]], dtype=torch.float64)
    frequency = torch.tensor([0.0, 1.0, 2.5, 4.0]).double()
    found = modulation_transfer(points, torch.ones(2).double(), frequency, "tangential")
    assert found.tolist() == pytest.approx(
        [abs(math.cos(math.pi * float(f) * 0.2)) for f in frequency], abs=1e-12
    )
    across = modulation_transfer(points, torch.ones(2).double(), frequency, "sagittal")
    assert across.tolist() == pytest.approx([1.0] * 4)


def test_second_derivative_at_zero_is_the_variance(spots):
    points, weights = spots
    share = weights / weights.sum()
    for axis, direction in enumerate(("sagittal", "tangential")):
        for spot in points:
            zero = torch.zeros(1, dtype=torch.float64, requires_grad=True)
            value = modulation_transfer(spot, weights, zero, direction).sum()
            (slope,) = torch.autograd.grad(value, zero, create_graph=True)
            (bend,) = torch.autograd.grad(slope.sum(), zero)
            variance = share @ (spot[:, axis] - share @ spot[:, axis]).square()
            assert abs(float(slope.detach())) < 1e-12
            assert float(bend) == pytest.approx(-((2.0 * math.pi) ** 2) * float(variance))


def test_it_can_be_differentiated_twice(spots):
    points, weights = spots[0][:1, :4].requires_grad_(), spots[1][:4].requires_grad_()
    frequency = torch.tensor([0.0, 8.0]).double()

    def transfer(points, weights):
        return modulation_transfer(points, weights, frequency, "tangential")

    assert gradcheck(transfer, (points, weights))
    assert gradgradcheck(transfer, (points, weights))


def test_gradients_stay_finite_where_contrast_vanishes_and_where_a_ray_is_left_out():
    points = torch.tensor([[0.0, 0.0], [0.0, 0.1], [math.nan, math.nan]], dtype=torch.float64)
    points.requires_grad_()
    weights = torch.tensor([1.0, 1.0, 0.0]).double()
    frequency = torch.tensor([5.0]).double()
    found = modulation_transfer(points, weights, frequency, "tangential")
    assert float(found.detach()) < 1e-12
    found.sum().backward()
    assert torch.isfinite(points.grad).all()


def test_directions_turn_with_the_points_and_shifts_do_not_count(spots):
    points, weights = spots
    frequency = torch.linspace(0.0, 20.0, 5).double()
    angle = 0.7
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
    along = turn @ torch.tensor([0.0, 1.0]).double()
    found = modulation_transfer(points @ turn.T + 3.0, weights, frequency, along)
    expected = modulation_transfer(points, weights, frequency, "tangential")
    assert found.shape == (3, 5)
    assert torch.allclose(found, expected, atol=1e-10)


def test_the_diffraction_limit_is_the_overlap_of_two_pupils():
    """Autocorrelation of the unit disc, integrated by mpmath, over its area."""
    wavelength, f_number = 500.0, 4.0
    cutoff = 1.0 / (wavelength * 1e-6 * f_number)
    for s in (0.0, 0.2, 0.5, 0.9, 1.0, 1.3):
        overlap = 4.0 * mpmath.quad(lambda x: mpmath.sqrt(1 - x * x), [min(s, 1.0), 1])
        found = diffraction_limited_transfer(
            torch.tensor([s * cutoff], dtype=torch.float64), wavelength, f_number
        )
        assert float(found) == pytest.approx(float(overlap / mpmath.pi), abs=1e-9)


def test_what_does_not_fit_is_refused(spots):
    points, weights = spots
    frequency = torch.ones(1).double()
    with pytest.raises(InputError, match="direction"):
        modulation_transfer(points, weights, frequency, "radial")
    with pytest.raises(InputError, match="points"):
        modulation_transfer(points, weights[:-1], frequency, "sagittal")
