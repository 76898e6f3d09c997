"""Random numbers of different seeds, stages and purposes are different ones."""

import itertools

import pytest
import torch

from dolens.experiments.camera.views.base import SCENE_OFFSET, seed_of
from dolens.sensor.noise import generator_of


def test_every_bit_of_a_seed_counts():
    drawn = {
        float(torch.rand((), dtype=torch.float64, generator=generator_of(1 << bit)))
        for bit in range(70)
    }
    assert len(drawn) == 70


def test_a_seed_gives_the_same_numbers_again():
    first, again = (torch.rand(5, generator=generator_of(12345)) for _ in range(2))
    assert torch.equal(first, again)


@pytest.mark.parametrize("offset", [0, 1 << 39, SCENE_OFFSET])
def test_seeds_and_stages_of_a_camera_share_no_numbers(offset):
    seeds = itertools.product((0, 1, 2), ("train", "val", "test"), (0, 1, 2))
    drawn = [
        float(torch.rand((), dtype=torch.float64, generator=generator_of(seed_of(*s) + offset)))
        for s in seeds
    ]
    assert len(set(drawn)) == 27
