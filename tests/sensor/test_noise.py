"""Noise of point spread functions as counted electrons, and of parts of a batch."""

import math

import pytest
import torch

from dolens.sensor.noise import BatchShare, noisy_point_spread_functions
from dolens.sensor.readout import Readout


def test_a_measured_function_has_poisson_s_spread_about_the_true_one():
    ramp = torch.arange(1.0, 10.0, dtype=torch.float64).reshape(3, 3)
    exact = (0.9 * ramp / ramp.sum()).expand(4000, 3, 3)
    electrons, read = 1000.0, 4.0
    found = noisy_point_spread_functions(exact, electrons, read, torch.Generator().manual_seed(0))
    assert torch.allclose(found.sum((-2, -1)), torch.tensor(0.9, dtype=torch.float64))
    share = exact[0] / 0.9
    # n_i over their sum Σn: to first order the variance is p(1 - p)/N for counting, and
    # σ²((1 - p)² + (K² - 1)·p²)/N² for read noise in all K² pixels.
    pixels = share.numel()
    counting = share * (1.0 - share) / electrons
    own = read**2 * ((1.0 - share) ** 2 + (pixels - 1) * share**2) / electrons**2
    expected = 0.9 * torch.sqrt(counting + own)
    assert torch.allclose(found.std(dim=0), expected, rtol=5.0 / math.sqrt(2.0 * 4000.0))
    assert float((found.mean(dim=0) - exact[0]).abs().max()) < 5.0 * float(expected.max()) / 60.0


def test_many_electrons_measure_the_function_itself():
    exact = torch.rand(2, 3, 5, 5, generator=torch.Generator().manual_seed(1))
    found = noisy_point_spread_functions(exact, 1e12, 0.0, torch.Generator().manual_seed(0))
    assert found.dtype == exact.dtype
    assert torch.allclose(found, exact, rtol=1e-4, atol=1e-5)
    with pytest.raises(AssertionError):
        few = noisy_point_spread_functions(exact, 1e2, 0.0, torch.Generator().manual_seed(0))
        assert torch.allclose(few, exact, rtol=1e-2)


READOUTS = {
    "electrons": Readout(exposure=0.5, full_well=900.0, read_noise=0.01, bits=10),
    "mosaic": Readout(full_well=500.0, read_noise=0.02, pattern="RGGB"),
}


@pytest.mark.parametrize("name", READOUTS)
@pytest.mark.parametrize("size", [1, 2, 3])
def test_parts_have_the_noise_of_the_whole(name, size):
    readout = READOUTS[name]
    image = torch.rand(6, 2, 3, 5, 7)

    def read(part, share=None):
        return readout(part, torch.Generator().manual_seed(3), share)

    parts = [read(image[i : i + size], BatchShare(i, 6)) for i in range(0, 6, size)]
    assert torch.equal(torch.cat(parts), read(image))
