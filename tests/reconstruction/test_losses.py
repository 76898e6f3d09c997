"""Losses between restored and true images, and the features that one of them compares."""

import copy
import io

import pytest
import torch
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import (
    RestorationLoss,
    VGG16Features,
    load_vgg16_weights,
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


@pytest.mark.parametrize("perceptual", ["none", "auto"])
def test_without_weights_it_trains_without_the_perceptual_term(perceptual):
    terms = RestorationLoss(perceptual=perceptual)(*images())
    assert terms.keys() == {"total", "mse", "tv"}
    torch.testing.assert_close(terms["total"], terms["mse"] + 1e-4 * terms["tv"])


def test_weight_zero_never_looks_for_weights(caplog):
    loss = RestorationLoss(perceptual_weight=0.0, perceptual="vgg16", vgg16_weights="/absent")
    assert not loss.perceptual_available
    assert caplog.records == []


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


# ---------------------------------------------------------------- features of VGG-16


def test_features_are_vgg16_up_to_the_third_convolution_of_the_third_block(vgg16_state):
    image, _ = images()
    expected = image.sub(torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1))
    expected = expected.div(torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1))
    for number in (0, 2, 5, 7, 10, 12, 14):
        weight, bias = vgg16_state[f"{number}.weight"], vgg16_state[f"{number}.bias"]
        expected = functional.conv2d(expected, weight, bias, padding=1)
        if number != 14:
            expected = expected.relu()
        if number in (2, 7):
            expected = functional.max_pool2d(expected, 2)
    features = VGG16Features(vgg16_state)(image)
    assert features.shape == (2, 256, 3, 4)
    torch.testing.assert_close(features, expected)


def test_features_are_frozen_and_see_the_image_clamped(vgg16_state):
    features = VGG16Features(vgg16_state)
    image, _ = images()
    assert not features.training
    assert not any(parameter.requires_grad for parameter in features.parameters())
    beyond = 3 * image - 1
    assert torch.equal(features(beyond), features(beyond.clamp(0, 1)))


def test_features_keep_their_own_copy_of_the_weights(vgg16_state):
    before = {name: value.clone() for name, value in vgg16_state.items()}
    VGG16Features(vgg16_state).double().layers[0].weight.zero_()
    assert all(torch.equal(vgg16_state[name], value) for name, value in before.items())
    assert all(value.dtype == torch.float32 for value in vgg16_state.values())


def test_loss_is_zero_for_equal_images_and_the_mean_square_otherwise(vgg16_state):
    features = VGG16Features(vgg16_state)
    restored, truth = images()
    assert perceptual_loss(features, truth, truth) == 0
    expected = (features(restored) - features(truth)).square().mean()
    assert expected > 0
    torch.testing.assert_close(perceptual_loss(features, restored, truth), expected)


def test_gradient_reaches_the_restored_image(vgg16_state):
    features = VGG16Features(vgg16_state).double()
    restored, truth = (image[:1].double() * 0.8 + 0.1 for image in images())
    restored.requires_grad_()
    perceptual_loss(features, restored, truth).backward()
    direction = torch.randn(restored.shape, generator=torch.Generator().manual_seed(1)).double()
    step = 1e-6
    ahead, behind = (
        perceptual_loss(features, restored.detach() + sign * step * direction, truth)
        for sign in (1, -1)
    )
    slope = (ahead - behind) / (2 * step)
    torch.testing.assert_close((restored.grad * direction).sum(), slope, rtol=1e-5, atol=0)


def test_a_features_only_file_and_a_full_one_give_the_same(vgg16_state, vgg16_file, tmp_path):
    full = {f"features.{name}": value for name, value in vgg16_state.items()}
    full["features.17.weight"] = full["classifier.0.weight"] = torch.zeros(1)
    torch.save(full, tmp_path / "full.pth")
    for file in (vgg16_file, str(tmp_path / "full.pth")):
        weights = load_vgg16_weights(file)
        assert weights.keys() == vgg16_state.keys()
        assert all(torch.equal(weights[name], vgg16_state[name]) for name in weights)


def test_features_fit_in_a_buffer_and_back(vgg16_state):
    buffer = io.BytesIO()
    torch.save(VGG16Features(vgg16_state).state_dict(), buffer)
    buffer.seek(0)
    assert "layers.0.weight" in torch.load(buffer, weights_only=True)


def test_weights_of_another_network_are_refused_by_layer(vgg16_state, tmp_path):
    cases = [
        ({"conv1.weight": torch.zeros(1)}, r"no features\.0\.weight"),
        ({**vgg16_state, "5.weight": torch.zeros(2, 2)}, r"features\.5\.weight has shape \(2, 2\)"),
    ]
    for content, message in cases:
        torch.save(content, tmp_path / "wrong.pth")
        with pytest.raises(InputError, match=message):
            load_vgg16_weights(str(tmp_path / "wrong.pth"))
