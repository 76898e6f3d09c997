import math

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from dolens.reconstruction import psnr_db, quality, structural_similarity


def truth(batch=2):
    generator = torch.Generator().manual_seed(0)
    return 0.3 + 0.4 * torch.rand(batch, 3, 24, 20, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("batch", [1, 3])
def test_psnr_of_a_known_offset_is_known_for_each_image(batch):
    offset = torch.tensor([0.1, 0.01, 0.2], dtype=torch.float64)[:batch]
    ratio = psnr_db(truth(batch) + offset.view(-1, 1, 1, 1), truth(batch))
    assert ratio.shape == (batch,)
    torch.testing.assert_close(ratio, -20 * torch.log10(offset))


def test_values_beyond_the_display_do_not_count():
    white = torch.ones(1, 3, 16, 16)
    assert psnr_db(white + 5, white).item() == math.inf
    torch.testing.assert_close(structural_similarity(white + 5, white), torch.ones(1))


@pytest.mark.parametrize("batch", [1, 3])
def test_structural_similarity_is_one_for_equal_images(batch):
    similarity = structural_similarity(truth(batch), truth(batch))
    torch.testing.assert_close(similarity, torch.ones(batch, dtype=torch.float64))


def test_structural_similarity_of_uniform_images_is_the_luminance_term():
    a, b, constant = 0.2, 0.6, 0.01**2
    images = [torch.full((1, 3, 16, 16), value, dtype=torch.float64) for value in (a, b)]
    expected = (2 * a * b + constant) / (a**2 + b**2 + constant)
    torch.testing.assert_close(structural_similarity(*images).item(), expected)


def test_the_worse_image_of_a_batch_scores_lower():
    noise = torch.randn(truth().shape, generator=torch.Generator().manual_seed(1)).double()
    restored = truth() + torch.tensor([0.01, 0.1]).view(2, 1, 1, 1) * noise
    for measure in (psnr_db, structural_similarity):
        good, bad = measure(restored, truth())
        assert good > bad


def test_strips_of_rows_give_the_same_similarity_as_the_whole(monkeypatch):
    generator = torch.Generator().manual_seed(2)
    restored = truth() + 0.1 * torch.randn(truth().shape, generator=generator).double()
    whole = structural_similarity(restored, truth())
    expected = structural_similarity_index_measure(
        restored.clamp(0, 1), truth(), reduction="none", data_range=1.0
    )
    torch.testing.assert_close(whole, expected)
    for pixels in (1, 13 * 2 * 20, 23 * 2 * 20):
        monkeypatch.setattr(quality, "_PIXELS", pixels)
        torch.testing.assert_close(structural_similarity(restored, truth()), whole)


def test_sizes_that_cannot_be_compared_are_refused():
    for measure in (psnr_db, structural_similarity):
        with pytest.raises(ValueError, match="expected one shape"):
            measure(torch.zeros(1, 3, 16, 16), torch.zeros(2, 3, 16, 16))
    with pytest.raises(ValueError, match="at least 11×11"):
        structural_similarity(torch.zeros(1, 3, 10, 16), torch.zeros(1, 3, 10, 16))
