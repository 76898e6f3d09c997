"""Crops of photographs: where they lie, in which order they come, and batches of them."""

import logging
import math

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.data.camera_data import CropDataModule
from dolens.experiments.data.crop_loading import EvaluationCrops, ResumableSampler, TrainingCrops
from dolens.experiments.data.crops import (
    _grid,
    centred_crop,
    centred_crops,
    crops_that_fit,
    linear_light,
    random_crop,
    random_order,
)
from dolens.experiments.data.photographs import Photograph
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear


def _noise(height=60, width=80, name="noise"):
    return Photograph(name, _photographs(1, height, width)[0].encoded)


def _photographs(count, height=20, width=24):
    generator = torch.Generator().manual_seed(0)
    size = 3, height, width
    return [
        Photograph(str(number), torch.randint(0, 256, size, generator=generator, dtype=torch.uint8))
        for number in range(count)
    ]


def _where(height=60, width=80):
    """A photograph whose every pixel tells its row (red) and column (green)."""
    encoded = torch.zeros(3, height, width, dtype=torch.uint8)
    encoded[0] = torch.arange(height)[:, None]
    encoded[1] = torch.arange(width)
    return Photograph("where", encoded)


def _bytes(crop):
    return (linear_to_srgb(crop) * 255).round().int()


def test_linear_light_is_the_decoded_byte():
    encoded = torch.arange(256, dtype=torch.uint8).view(1, 16, 16)
    expected = srgb_to_linear(encoded.double() / 255)
    assert linear_light(encoded).dtype == torch.float32
    assert torch.allclose(linear_light(encoded).double(), expected, atol=1e-7)


def test_a_crop_is_a_function_of_seed_and_index():
    photo = _noise()

    def crop(seed, index):
        return random_crop(photo, (16, 12), seed, index, (1.0, 2.0))

    first = crop(3, 100)
    torch.rand(5)
    crop(3, 101)
    assert first.shape == (3, 16, 12)
    assert first.dtype == torch.float32
    assert first.min() >= 0 and first.max() <= 1
    assert torch.equal(crop(3, 100), first)
    assert not torch.equal(crop(3, 101), first)
    assert not torch.equal(crop(4, 100), first)


def test_at_scale_one_pixels_are_copied_from_everywhere():
    photo, tops, lefts = _where(), set(), set()
    for index in range(300):
        crop = _bytes(random_crop(photo, (50, 70), 0, index, flip_horizontal=False))
        top, left = int(crop[0, 0, 0]), int(crop[1, 0, 0])
        expected = photo.encoded[:, top : top + 50, left : left + 70]
        assert torch.equal(crop, expected.int())
        tops.add(top)
        lefts.add(left)
    assert tops == lefts == set(range(11))


@pytest.mark.parametrize("horizontal", [False, True])
@pytest.mark.parametrize("vertical", [False, True])
def test_flips_happen_half_of_the_time_and_only_when_asked(horizontal, vertical):
    photo = _where()
    crops = [
        _bytes(
            random_crop(photo, (8, 8), 0, index, flip_horizontal=horizontal, flip_vertical=vertical)
        )
        for index in range(100)
    ]
    mirrored = sum(int(crop[1, 0, 0] > crop[1, 0, -1]) for crop in crops)
    upside_down = sum(int(crop[0, 0, 0] > crop[0, -1, 0]) for crop in crops)
    assert 30 < mirrored < 70 if horizontal else mirrored == 0
    assert 30 < upside_down < 70 if vertical else upside_down == 0


def test_scale_is_log_uniform_in_its_range():
    photo = _where(250, 250)
    spans = torch.tensor(
        [
            float(crop[1, 0, -1] - crop[1, 0, 0]) / 19
            for crop in (
                _bytes(random_crop(photo, (20, 20), 0, i, (1.0, 4.0), flip_horizontal=False))
                for i in range(200)
            )
        ]
    )
    assert spans.min() > 0.9 and spans.max() < 4.2
    assert abs(spans.log().mean() - math.log(2)) < 0.1
    assert abs((spans < 2).float().mean() - 0.5) < 0.1


def test_resizing_is_done_in_linear_light():
    # Black and white lines, two of them to a texel: half the light, encoded as 188 and not 128.
    encoded = torch.zeros(3, 64, 64, dtype=torch.uint8)
    encoded[:, ::2] = 255
    crop = random_crop(Photograph("lines", encoded), (16, 16), 0, 0, (4.0, 4.0))
    assert abs(crop[:, 2:-2, 2:-2] - 0.5).max() < 0.02


def test_a_ramp_of_light_keeps_its_mean():
    ramp = torch.linspace(0.1, 0.9, 64).expand(3, 64, 64)
    photo = Photograph("ramp", (linear_to_srgb(ramp) * 255).round().to(torch.uint8))
    crop = random_crop(photo, (32, 32), 0, 0, (2.0, 2.0), flip_horizontal=False)
    assert abs(crop.mean() - 0.5) < 2e-3
    centres = (ramp[0, 0, ::2] + ramp[0, 0, 1::2]) / 2
    assert torch.allclose(crop[0, 5], centres, atol=8e-3)


def test_a_photograph_narrows_the_range_of_scales_without_a_word(caplog):
    for index in range(20):
        random_crop(_noise(40, 40, "narrow"), (30, 30), 0, index, (1.0, 3.0))
    assert not caplog.records


def test_a_small_photograph_is_enlarged_with_one_warning(caplog):
    photo = _noise(10, 20, "tiny.png")
    with caplog.at_level(logging.WARNING):
        crops = [random_crop(photo, (30, 30), 0, index) for index in range(5)]
        crops.extend(centred_crops(photo, (30, 30), 1))
    assert all(crop.shape == (3, 30, 30) for crop in crops)
    assert [record.message.split(":")[0] for record in caplog.records] == ["tiny.png"]


def test_one_centred_crop_is_the_centre():
    crop = _bytes(centred_crops(_where(), (20, 30), 1))
    assert crop[0, :2, 0, 0].tolist() == [20, 25]
    assert torch.equal(crop[0], _where().encoded[:, 20:40, 25:55].int())


# Three by four crops of 20 × 20 fill the one photograph but for a few pixels, and lie free in the
# other.
@pytest.mark.parametrize("size", [(62, 83), (80, 107)])
@pytest.mark.parametrize("count", range(1, 13))
def test_every_count_that_fits_is_cut_without_overlap(count, size):
    photo = _where(*size)
    assert crops_that_fit(photo, (20, 20)) >= 12
    seen = torch.zeros(size)
    for crop in _bytes(centred_crops(photo, (20, 20), count)):
        top, left = int(crop[0, 0, 0]), int(crop[1, 0, 0])
        seen[top : top + 20, left : left + 20] += 1
    assert seen.max() == 1
    assert seen.sum() == count * 400


def test_more_crops_than_fit_are_refused():
    with pytest.raises(
        InputError, match="where: 2 crops of 40×60 of its 60×80 pixels would overlap"
    ):
        centred_crops(_where(), (40, 60), 2)
    with pytest.raises(InputError, match="at most 4"):
        centred_crops(_where(), (20, 20), 5, scale=1.5)


def test_what_fits_is_told_and_a_photograph_smaller_than_a_crop_holds_one():
    assert crops_that_fit(_noise(62, 83), (20, 20)) == 12
    assert crops_that_fit(_noise(10, 19, "one"), (30, 30)) == 1


def test_the_grid_follows_the_photograph():
    assert _grid(_noise(20, 80), (20, 20), 4) == (1, 4)
    assert _grid(_noise(80, 20), (20, 20), 4) == (4, 1)


def test_centred_crops_at_a_scale_cover_more():
    crop = _bytes(centred_crop(_where(), (15, 20), 1, 0, scale=4.0))
    assert crop[0, -1, 0] - crop[0, 0, 0] > 50


def test_orders_are_permutations_of_their_own():
    orders = [random_order(10, 1, number).tolist() for number in range(5)]
    assert all(sorted(order) == list(range(10)) for order in orders)
    assert len({tuple(order) for order in orders}) == 5
    assert random_order(10, 1, 3).tolist() == orders[3]
    assert random_order(10, 2, 3).tolist() != orders[3]


@pytest.mark.parametrize(
    ("size", "seed", "index", "scales", "word"),
    [
        ((0, 4), 0, 0, (1.0, 1.0), "crop size"),
        ((4, 4), -1, 0, (1.0, 1.0), "seed"),
        ((4, 4), 0, -1, (1.0, 1.0), "sample"),
        ((4, 4), 0, 0, (2.0, 1.0), "crop scale"),
        ((4, 4), 0, 0, (0.0, 1.0), "crop scale"),
        ((4, 4), 0, 0, (1.0, math.nan), "crop scale"),
    ],
)
def test_bad_arguments_are_named(size, seed, index, scales, word):
    with pytest.raises(InputError, match=word):
        random_crop(_noise(), size, seed, index, scales)


def test_bad_counts_are_named():
    with pytest.raises(InputError, match="crops of one photograph: 0"):
        centred_crops(_noise(), (4, 4), 0)
    with pytest.raises(InputError, match="crop 2 of 2"):
        centred_crop(_noise(), (4, 4), 2, 2)


# ---------------------------------------------------------------- all crops of photographs


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


# ---------------------------------------------------------------- a module of data


class _Data(CropDataModule):
    def load_split(self, split):
        number = len(split)  # another photograph for each
        return [_photographs(number, 40, 50)[-1]] * 3


def test_batches_hold_crop_and_margin():
    data = _Data(crop_size=(8, 12), margin=3, batch_size=2, steps_per_epoch=4)
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert data.item_size == (14, 18)
    assert len(batches) == len(data.train_dataloader()) == 4
    for batch in batches:
        assert batch.shape == (2, 3, 14, 18)
        assert batch.dtype == torch.float32
        assert batch.min() >= 0 and batch.max() <= 1


def test_evaluation_batches_are_always_the_same():
    data = _Data(crop_size=8, batch_size=4, evaluation_crops_per_photograph=2)
    first, second = (torch.cat(list(data.val_dataloader())) for _ in range(2))
    assert first.shape == (6, 3, 8, 8)
    assert torch.equal(first, second)
    assert not torch.equal(torch.cat(list(data.test_dataloader())), first)


def test_the_most_detailed_crop_is_the_one_whose_texels_differ_most():
    class Striped(_Data):
        def load_split(self, split):
            flat = torch.full((3, 12, 12), 90, dtype=torch.uint8)
            striped = flat.clone()
            striped[..., ::2] = 200
            return [Photograph("flat", flat), Photograph("striped", striped)]

    found = Striped(crop_size=8, margin=2).most_detailed()
    assert found.shape == (1, 3, 12, 12)
    assert float(found.diff(dim=-1).abs().mean()) > 0.1


def test_a_stage_loads_only_what_it_needs():
    class Recording(_Data):
        loaded: list[str]

        def load_split(self, split):
            self.loaded.append(split)
            return super().load_split(split)

    data = Recording()
    data.loaded = []
    data.setup("test")
    assert data.loaded == ["test"]
    data.setup()
    assert sorted(data.loaded) == ["test", "train", "validation"]


@pytest.mark.parametrize(
    "arguments",
    [
        {"crop_size": 0},
        {"crop_size": (4,)},
        {"crop_size": "4x4"},
        {"margin": -1},
        {"batch_size": 0},
        {"batch_size": 2.5},
        {"steps_per_epoch": 0},
        {"scale_range": (2.0, 1.0)},
        {"scale_range": 2.0},
        {"evaluation_crops_per_photograph": 0},
        {"evaluation_scale": 0.0},
        {"num_workers": -1},
        {"num_workers": 10**12},
        {"prefetch": 10**12},
        {"seed": -1},
    ],
)
def test_bad_settings_of_the_data_are_named(arguments):
    (name,) = arguments
    with pytest.raises(InputError, match=rf"data\.{name}: .*; allowed: "):
        _Data(**arguments)
