"""Published weights: where they are looked for, what is said without them, and who asks."""

import logging
import pickle
import socket
from dataclasses import replace

import pytest
import torch
from torchvision.models import mobilenet_v2

from dolens.errors import InputError
from dolens.reconstruction import (
    PretrainedWeightsUnavailable,
    RestorationLoss,
    load_backbone,
    torchvision_weights,
)
from dolens.reconstruction.torchvision_weights import PublishedWeights

FILE_NAME = "tiny-0a1b2c3d.pth"


# Taken before the fixture in conftest.py puts a failure in its place.
REAL_DOWNLOAD = torch.hub.download_url_to_file


WEIGHTS = PublishedWeights(
    network="TinyNet",
    purpose="this test",
    address=lambda: "https://example.org/models/tiny-0a1b2c3d.pth",
    megabytes=1,
    key="group.tiny_file",
    choice="group.tiny",
)


EXPECTED = {"a.weight": torch.empty(2, 3, device="meta"), "b.bias": torch.empty(4, device="meta")}


STATE = {"a.weight": torch.rand(2, 3), "b.bias": torch.rand(4)}


def in_cache(torch_cache, name, state):
    torch_cache.mkdir(parents=True)
    torch.save(state, torch_cache / name)


def test_exactly_the_expected_parameters_come_back_and_the_log_names_their_file(tmp_path, caplog):
    file = tmp_path / "own.pth"
    torch.save(STATE | {"c.weight": torch.rand(1)}, file)
    with caplog.at_level(logging.INFO, logger="dolens.reconstruction"):
        found = WEIGHTS.load(str(file), EXPECTED)
    assert found.keys() == EXPECTED.keys()
    assert all(torch.equal(found[name], STATE[name]) for name in found)
    (said,) = (record.getMessage() for record in caplog.records)
    assert said == f"TinyNet weights for this test: {file}"


def test_the_cache_is_looked_into_under_the_published_name(torch_cache):
    in_cache(torch_cache, FILE_NAME, STATE)
    assert torch.equal(WEIGHTS.load(None, EXPECTED)["b.bias"], STATE["b.bias"])


def test_without_leave_to_download_the_network_is_not_touched(torch_cache, monkeypatch):
    def touched(*args, **kwargs):
        raise AssertionError("the network was used")

    monkeypatch.setattr(torch.hub, "download_url_to_file", touched)
    with pytest.raises(PretrainedWeightsUnavailable) as caught:
        WEIGHTS.load(None, EXPECTED)
    assert str(caught.value) == (
        f"no TinyNet weights for this test: give group.tiny_file=FILE; or put tiny-0a1b2c3d.pth "
        f"into {torch_cache}; or allow the download of https://example.org/models/"
        "tiny-0a1b2c3d.pth (1 MB) by group.tiny=download"
    )
    assert not torch_cache.exists()


def test_a_download_is_announced_checked_and_kept(torch_cache, monkeypatch, caplog):
    def download(url, destination, hash_prefix, progress):
        assert "downloading" in caplog.text  # said before it begins
        assert (url.rsplit("/", 1)[-1], hash_prefix) == (FILE_NAME, "0a1b2c3d")
        assert socket.getdefaulttimeout() == 10
        torch.save(STATE, destination)

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    assert "b.bias" in WEIGHTS.load(None, EXPECTED, download=True)
    assert (torch_cache / FILE_NAME).is_file()
    levels = [record.levelno for record in caplog.records]
    assert [level for level in levels if level > logging.INFO] == [logging.WARNING]
    assert socket.getdefaulttimeout() is None


def test_offline_the_message_says_why_the_download_failed_and_what_to_do(torch_cache):
    with pytest.raises(PretrainedWeightsUnavailable) as caught:
        WEIGHTS.load(None, EXPECTED, download=True)
    message = str(caught.value)
    assert isinstance(caught.value, InputError) and "\n" not in message
    assert f"put {FILE_NAME} into {torch_cache}" in message
    for words in ("give group.tiny_file=FILE", "the download of https", "no network in tests"):
        assert words in message
    assert socket.getdefaulttimeout() is None


def test_a_server_that_never_answers_is_given_up(torch_cache, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/{FILE_NAME}"
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        monkeypatch.setattr(torchvision_weights, "DOWNLOAD_TIMEOUT_S", 0.2)
        monkeypatch.setattr(torch.hub, "download_url_to_file", REAL_DOWNLOAD)
        with pytest.raises(PretrainedWeightsUnavailable, match="timed out"):
            replace(WEIGHTS, address=lambda: url).load(None, EXPECTED, download=True)
    assert list(torch_cache.iterdir()) == []  # no half file is left for the next run


class Trap:
    """Executes what it likes when it is unpickled."""

    def __reduce__(self):
        return (open, ("sprung", "w"))


# What a file holds, and what is said of it.
REFUSED = [
    (None, r": no such file"),
    (b"", ": cannot be read as PyTorch weights"),
    (b"not weights", ": cannot be read as PyTorch weights"),
    (pickle.dumps(print, protocol=2), ": cannot be read as PyTorch weights"),
    (Trap(), ": cannot be read as PyTorch weights"),
    ([1, 2], ": holds no state dict"),
    ({"conv1.weight": torch.zeros(1)}, r": holds no a\.weight|: no a\.weight"),
    (STATE | {"a.weight": torch.rand(3, 2)},
     r": a\.weight has shape \(3, 2\), in TinyNet it is \(2, 3\)$"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "said"), REFUSED)
def test_other_files_are_refused_in_one_line(content, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "own.pth"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        torch.save(content, file)
    with pytest.raises(InputError, match=rf"^tiny_file {file}{said}") as caught:
        WEIGHTS.load(str(file), EXPECTED)
    assert "\n" not in str(caught.value)
    assert not isinstance(caught.value, PretrainedWeightsUnavailable)
    assert not (tmp_path / "sprung").exists()


# ---------------------------------------------------------------- who asks for them


def backbone(word, file=None):
    return load_backbone("mobilenet_v2", stages=2, weights=word, weights_file=file)


def loss(word, file=None):
    return RestorationLoss(perceptual=word, vgg16_weights=file)


# Makes it, whether it has weights, the word that insists on them, and what is said without them.
USERS = {
    "backbone": (backbone, "pretrained", "imagenet", "MobileNetV2",
                 ("THE BACKBONE STARTS FROM RANDOM WEIGHTS", "give network.weights_file=FILE",
                  "by network.weights=download"), "the network's backbone (14 MB)"),
    "loss": (loss, "perceptual_available", "vgg16", "VGG-16",
             ("WITHOUT THE PERCEPTUAL TERM", "loss.vgg16_weights=FILE",
              "by loss.perceptual=download"), "the perceptual loss (528 MB)"),
}  # fmt: skip


@pytest.fixture(params=USERS)
def user(request):
    return USERS[request.param]


def test_auto_without_weights_says_so_once_and_downloads_nothing(user, caplog):
    make, has, _, _, words, _ = user
    with caplog.at_level(logging.WARNING, logger="dolens.reconstruction"):
        assert not getattr(make("auto"), has)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert all(word in record.getMessage() for word in words)


def test_weights_that_must_be_there_and_are_not_are_an_error(user, caplog):
    make, _, insist, network, words, _ = user
    with pytest.raises(PretrainedWeightsUnavailable, match=f"no {network} weights.*{words[-1]}"):
        make(insist)
    assert caplog.records == []


def test_only_the_word_download_uses_the_network(user, caplog):
    make, _, _, network, _, size = user
    with pytest.raises(PretrainedWeightsUnavailable, match="no network in tests"):
        make("download")
    assert f"downloading {network} weights for {size}" in caplog.text


def test_none_is_without_them_in_silence(user, caplog):
    make, has, *_ = user
    assert not getattr(make("none"), has)
    assert caplog.records == []


def test_a_given_file_that_is_missing_is_an_error_whatever_the_word(user):
    make, _, insist, *_ = user
    for word in ("auto", insist):
        with pytest.raises(InputError, match=r"weights(_file)? /absent\.pth: no such file"):
            make(word, "/absent.pth")


def test_the_torch_cache_serves_without_a_word(torch_cache, vgg16_state, caplog):
    in_cache(torch_cache, "vgg16-397923af.pth", vgg16_state)
    torch.save(mobilenet_v2().state_dict(), torch_cache / "mobilenet_v2-b0353104.pth")
    for make, has, *_ in USERS.values():
        assert getattr(make("auto"), has)
    assert [record for record in caplog.records if record.levelno > logging.INFO] == []
