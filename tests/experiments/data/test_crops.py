import logging
import math

import pytest
import torch

from dolens.errors import InputError
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
    generator = torch.Generator().manual_seed(0)
    encoded = torch.randint(0, 256, (3, height, width), generator=generator, dtype=torch.uint8)
    return Photograph(name, encoded)


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


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 12])
def test_centred_crops_do_not_overlap_where_there_is_room(count):
    seen = torch.zeros(60, 80)
    for crop in _bytes(centred_crops(_where(), (15, 20), count)):
        top, left = int(crop[0, 0, 0]), int(crop[1, 0, 0])
        seen[top : top + 15, left : left + 20] += 1
    assert seen.max() == 1
    assert seen.sum() == count * 300


@pytest.mark.parametrize("count", range(1, 13))
def test_every_count_that_fits_is_cut_without_overlap(count):
    # Three by four crops of 20 × 20 fill the photograph but for a few pixels.
    photo = _where(62, 83)
    assert crops_that_fit(photo, (20, 20)) == 12
    seen = torch.zeros(62, 83)
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


def test_a_photograph_smaller_than_a_crop_holds_one():
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
