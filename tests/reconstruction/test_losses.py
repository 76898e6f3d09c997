import copy
import logging

import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import (
    PretrainedWeightsUnavailable,
    RestorationLoss,
    VGG16Features,
    mean_absolute_error,
    mean_squared_error,
    perceptual_loss,
    total_variation,
)


def images(dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    return tuple(torch.rand(2, 3, 12, 16, generator=generator, dtype=dtype) for _ in range(2))


def test_mean_squared_error_of_a_known_offset():
    truth = torch.rand(2, 3, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(mean_squared_error(truth + 0.2, truth).item(), 0.04)


def test_mean_absolute_error_of_offsets_of_either_sign():
    truth = torch.rand(2, 3, 4, 6, dtype=torch.float64)
    offset = torch.tensor([0.2, -0.4]).repeat(3)
    torch.testing.assert_close(mean_absolute_error(truth + offset, truth).item(), 0.3)


@pytest.mark.parametrize("error", [mean_squared_error, mean_absolute_error])
def test_errors_do_not_broadcast(error):
    with pytest.raises(ValueError, match="differ"):
        error(torch.zeros(2, 3, 4, 4), torch.zeros(1, 3, 4, 4))


def test_total_variation_of_a_ramp_is_the_sum_of_its_slopes():
    y, x = torch.meshgrid(torch.arange(7.0), torch.arange(5.0), indexing="ij")
    ramp = (0.3 * x - 0.1 * y).expand(2, 3, 7, 5)
    torch.testing.assert_close(total_variation(ramp).item(), 0.4)


def test_total_variation_of_a_uniform_image_and_of_one_pixel_is_zero():
    assert total_variation(torch.full((1, 3, 6, 6), 0.7)) == 0
    assert total_variation(torch.ones(1, 3, 1, 1)) == 0


def test_total_variation_of_a_step_counts_its_edge_once():
    image = torch.zeros(1, 1, 4, 5)
    image[..., 2:] = 1  # one edge of height 1 among four differences a row
    assert total_variation(image) == 0.25


def test_total_is_the_weighted_sum_of_unweighted_terms(vgg16_file, vgg16_state):
    restored, truth = images()
    loss = RestorationLoss(2.0, 0.3, 0.05, perceptual="vgg16", vgg16_weights=vgg16_file)
    terms = loss(restored, truth)
    assert loss.perceptual_available
    assert terms.keys() == {"total", "mse", "tv", "perceptual"}
    assert terms["mse"] == mean_squared_error(restored, truth)
    assert terms["tv"] == total_variation(restored)
    expected = perceptual_loss(VGG16Features(vgg16_state), restored, truth)
    torch.testing.assert_close(terms["perceptual"], expected)
    total = 2.0 * terms["mse"] + 0.3 * terms["tv"] + 0.05 * terms["perceptual"]
    torch.testing.assert_close(terms["total"], total)
    assert all(value.ndim == 0 for value in terms.values())


def test_the_l1_term_joins_where_it_has_a_weight():
    restored, truth = images()
    terms = RestorationLoss(0.0, 0.0, perceptual="none", l1_weight=0.7)(restored, truth)
    assert terms["l1"] == mean_absolute_error(restored, truth)
    torch.testing.assert_close(terms["total"], 0.7 * terms["l1"])


def test_equal_images_leave_only_the_total_variation(vgg16_file):
    truth = images()[1]
    terms = RestorationLoss(vgg16_weights=vgg16_file)(truth, truth)
    assert terms["mse"] == 0 and terms["perceptual"] == 0
    torch.testing.assert_close(terms["total"], 1e-4 * total_variation(truth))


def test_the_feature_network_enters_no_checkpoint_and_no_optimizer(vgg16_file):
    loss = RestorationLoss(vgg16_weights=vgg16_file)
    loss(*images())
    assert loss.state_dict() == {}
    assert list(loss.parameters()) == [] and list(loss.buffers()) == []
    assert copy.deepcopy(loss).perceptual_available


def test_the_feature_network_follows_the_dtype_of_the_images(vgg16_file):
    loss = RestorationLoss(vgg16_weights=vgg16_file)
    single = loss(*images())["perceptual"]
    double = loss(*(image.double() for image in images()))["perceptual"]
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(double.float(), single)


def test_a_half_precision_batch_does_not_round_the_feature_network(vgg16_file):
    loss = RestorationLoss(vgg16_weights=vgg16_file)
    before = loss(*images())["perceptual"]
    loss(*(image.bfloat16() for image in images()))
    assert loss(*images())["perceptual"] == before


def test_training_works_after_validation_in_inference_mode(vgg16_file):
    loss = RestorationLoss(vgg16_weights=vgg16_file)
    restored, truth = images(torch.float64)  # another dtype, so that the weights are moved
    with torch.inference_mode():
        loss(restored, truth)
    restored.requires_grad_()
    loss(restored, truth)["perceptual"].backward()
    assert restored.grad.abs().max() > 0


def test_none_trains_without_the_perceptual_term_in_silence(caplog):
    loss = RestorationLoss(perceptual="none")
    assert not loss.perceptual_available
    assert loss(*images()).keys() == {"total", "mse", "tv"}
    assert caplog.records == []


def test_weight_zero_never_looks_for_weights(caplog):
    loss = RestorationLoss(perceptual_weight=0.0, perceptual="vgg16", vgg16_weights="/absent")
    assert not loss.perceptual_available
    assert caplog.records == []


def test_auto_without_weights_warns_once_and_trains(caplog):
    with caplog.at_level(logging.WARNING, logger="dolens.reconstruction.losses"):
        loss = RestorationLoss(perceptual="auto")
        terms = [loss(*images()) for _ in range(2)][-1]
    said = [record for record in caplog.records if record.name == "dolens.reconstruction.losses"]
    assert len(said) == 1
    assert said[0].levelno == logging.WARNING
    assert "WITHOUT THE PERCEPTUAL TERM" in said[0].getMessage()
    assert "loss.vgg16_weights=FILE" in said[0].getMessage()
    torch.testing.assert_close(terms["total"], terms["mse"] + 1e-4 * terms["tv"])


def test_only_the_word_download_uses_the_network(caplog):
    RestorationLoss(perceptual="auto")
    with pytest.raises(PretrainedWeightsUnavailable):
        RestorationLoss(perceptual="vgg16")
    assert "downloading" not in caplog.text
    with pytest.raises(PretrainedWeightsUnavailable, match="no network in tests"):
        RestorationLoss(perceptual="download")
    assert "downloading VGG-16 weights for the perceptual loss (528 MB)" in caplog.text


def test_vgg16_without_weights_refuses():
    with pytest.raises(PretrainedWeightsUnavailable, match=r"by loss\.perceptual=download"):
        RestorationLoss(perceptual="vgg16")


@pytest.mark.parametrize("perceptual", ["auto", "vgg16"])
def test_a_given_file_that_is_missing_is_an_error_in_every_mode(perceptual):
    with pytest.raises(InputError, match=r"/absent\.pth: no such file"):
        RestorationLoss(perceptual=perceptual, vgg16_weights="/absent.pth")


def test_another_word_gets_the_allowed_ones_and_the_nearest():
    with pytest.raises(
        InputError,
        match=r"vgg19: .* auto, vgg16, download, vgg16_edges, none; did you mean vgg16\?",
    ):
        RestorationLoss(perceptual="vgg19")


def test_a_negative_weight_is_refused_by_name():
    for name in ("tv_weight", "l1_weight"):
        with pytest.raises(InputError, match=f"{name}=-1"):
            RestorationLoss(perceptual="none", **{name: -1})
