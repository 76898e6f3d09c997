"""Parts of a batch have the noise that they have in the whole batch."""

import pytest
import torch

from dolens.sensor.noise import BatchShare
from dolens.sensor.readout import Readout

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
