import io
import logging
import pickle
import socket
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import (
    PretrainedWeightsUnavailable,
    VGG16Features,
    load_vgg16_weights,
    losses,
    perceptual_loss,
    torchvision_weights,
)

FILE_NAME = "vgg16-397923af.pth"
# Taken before the fixture in conftest.py puts a failure in its place.
REAL_DOWNLOAD = torch.hub.download_url_to_file


def images():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, 16, 12, generator=generator), torch.rand(
        2, 3, 16, 12, generator=generator
    )


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
    assert features.shape == (2, 256, 4, 3)
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


def test_the_torch_cache_is_used_without_a_download(vgg16_state, torch_cache):
    torch_cache.mkdir(parents=True)
    torch.save(vgg16_state, torch_cache / FILE_NAME)
    assert torch.equal(load_vgg16_weights(None)["14.bias"], vgg16_state["14.bias"])


def test_a_download_is_announced_checked_and_kept(vgg16_file, torch_cache, monkeypatch, caplog):
    def download(url, destination, hash_prefix, progress):
        assert "downloading" in caplog.text  # said before it begins
        assert (url.rsplit("/", 1)[-1], hash_prefix) == (FILE_NAME, "397923af")
        assert socket.getdefaulttimeout() == 10
        with open(vgg16_file, "rb") as source, open(destination, "wb") as target:
            target.write(source.read())

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    assert "0.weight" in load_vgg16_weights(None, download=True)
    assert (torch_cache / FILE_NAME).is_file()
    levels = [record.levelno for record in caplog.records]
    assert [level for level in levels if level > logging.INFO] == [logging.WARNING]
    assert socket.getdefaulttimeout() is None


def test_offline_the_message_says_why_the_download_failed_and_what_to_do(torch_cache):
    with pytest.raises(PretrainedWeightsUnavailable) as caught:
        load_vgg16_weights(None, download=True)
    message = str(caught.value)
    assert isinstance(caught.value, InputError)
    assert "\n" not in message
    assert "loss.vgg16_weights=FILE" in message
    assert f"put {FILE_NAME} into {torch_cache}" in message
    assert "the download of https://download.pytorch.org/models/" in message
    assert "no network in tests" in message
    assert socket.getdefaulttimeout() is None


def test_a_server_that_never_answers_is_given_up(torch_cache, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/{FILE_NAME}"
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        monkeypatch.setattr(losses, "VGG16", replace(losses.VGG16, url=url))
        monkeypatch.setattr(torchvision_weights, "DOWNLOAD_TIMEOUT_S", 0.2)
        monkeypatch.setattr(torch.hub, "download_url_to_file", REAL_DOWNLOAD)
        with pytest.raises(PretrainedWeightsUnavailable, match="timed out"):
            load_vgg16_weights(None, download=True)
    assert list(torch_cache.iterdir()) == []  # no half file is left for the next run


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"absent\.pth: no such file") as caught:
        load_vgg16_weights(str(tmp_path / "absent.pth"))
    assert not isinstance(caught.value, PretrainedWeightsUnavailable)


@pytest.mark.parametrize("content", [b"", b"not weights", pickle.dumps(print, protocol=2)])
def test_a_file_of_another_kind_is_named(tmp_path, content):
    file = tmp_path / "other.pth"
    file.write_bytes(content)
    with pytest.raises(
        InputError, match=r"other\.pth: cannot be read as PyTorch weights"
    ) as caught:
        load_vgg16_weights(str(file))
    assert "\n" not in str(caught.value)


def test_a_file_that_would_run_code_is_not_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    torch.save(Trap(), tmp_path / "trap.pth")
    with pytest.raises(InputError, match=r"trap\.pth"):
        load_vgg16_weights(str(tmp_path / "trap.pth"))
    assert not (tmp_path / "sprung").exists()


def test_weights_of_another_network_are_refused_by_layer(vgg16_state, tmp_path):
    file = str(tmp_path / "wrong.pth")
    cases = [
        ([1, 2], "holds no state dict"),
        ({"conv1.weight": torch.zeros(1)}, r"no features\.0\.weight"),
        ({**vgg16_state, "5.weight": torch.zeros(2, 2)}, r"features\.5\.weight has shape \(2, 2\)"),
    ]
    for content, message in cases:
        torch.save(content, file)
        with pytest.raises(InputError, match=message):
            load_vgg16_weights(file)


def test_features_fit_in_a_buffer_and_back(vgg16_state):
    buffer = io.BytesIO()
    torch.save(VGG16Features(vgg16_state).state_dict(), buffer)
    buffer.seek(0)
    assert "layers.0.weight" in torch.load(buffer, weights_only=True)
