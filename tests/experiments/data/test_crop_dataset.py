import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.data.crop_loading import EvaluationCrops, ResumableSampler, TrainingCrops
from dolens.experiments.data.crops import centred_crops, random_crop
from dolens.experiments.data.photographs import Photograph


def _photographs(count):
    generator = torch.Generator().manual_seed(0)
    return [
        Photograph(
            str(number),
            torch.randint(0, 256, (3, 20, 24), generator=generator, dtype=torch.uint8),
        )
        for number in range(count)
    ]


def test_each_pass_shows_every_photograph_once_in_its_own_order():
    dataset = TrainingCrops(_photographs(7), (8, 8), seed=5)
    passes = [[dataset.photograph_number(7 * p + i) for i in range(7)] for p in range(4)]
    assert all(sorted(order) == list(range(7)) for order in passes)
    assert len({tuple(order) for order in passes}) > 1


def test_items_do_not_depend_on_what_was_asked_before():
    photographs = _photographs(3)
    dataset = TrainingCrops(photographs, (8, 8), 5, (1.0, 2.0), flip_vertical=True)
    forward = [dataset[index] for index in range(12)]
    fresh = TrainingCrops(photographs, (8, 8), 5, (1.0, 2.0), flip_vertical=True)
    for index in reversed(range(12)):
        assert torch.equal(fresh[index], forward[index])
    far = 10**12 + 1
    photo = photographs[dataset.photograph_number(far)]
    expected = random_crop(photo, (8, 8), 5, far, (1.0, 2.0), flip_vertical=True)
    assert torch.equal(dataset[far], expected)


def test_evaluation_goes_photograph_by_photograph():
    photographs = _photographs(2)
    dataset = EvaluationCrops(photographs, (6, 5), count=3, scale=1.5)
    assert len(dataset) == 6
    assert dataset.names() == ["0", "0", "0", "1", "1", "1"]
    expected = torch.cat([centred_crops(photo, (6, 5), 3, 1.5) for photo in photographs])
    assert torch.equal(torch.stack([dataset[index] for index in range(6)]), expected)
    with pytest.raises(IndexError):
        dataset[6]


def test_a_small_photograph_gives_fewer_crops_than_a_large_one():
    large, small = torch.zeros(3, 40, 60), torch.zeros(3, 30, 31)
    photographs = [Photograph("large", large.byte()), Photograph("small", small.byte())]
    dataset = EvaluationCrops(photographs, (20, 20), count=4)
    assert dataset.names() == ["large"] * 4 + ["small"]
    assert len(dataset) == 5
    assert torch.equal(dataset[4], centred_crops(photographs[1], (20, 20), 1)[0])


def test_no_photographs_is_an_error():
    with pytest.raises(InputError, match="no photographs"):
        TrainingCrops([], (8, 8), 0)
    with pytest.raises(InputError, match="no photographs"):
        EvaluationCrops([], (8, 8), 1)
    with pytest.raises(InputError, match="evaluation crops of a photograph: 0"):
        EvaluationCrops(_photographs(1), (8, 8), 0)


def test_the_sampler_asks_where_to_begin_at_each_iteration():
    places = iter([(0, 6), (8, 4), (12, 6)])
    sampler = ResumableSampler(6, lambda: next(places))
    assert len(sampler) == 6
    assert list(sampler) == [0, 1, 2, 3, 4, 5]
    assert list(sampler) == [8, 9, 10, 11]
    assert list(sampler) == [12, 13, 14, 15, 16, 17]
    with pytest.raises(InputError, match="samples of an epoch: 0"):
        ResumableSampler(0, lambda: (0, 0))
