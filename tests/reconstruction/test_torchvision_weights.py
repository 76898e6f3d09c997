"""What test_perceptual.py does not show of the search for weights with VGG-16's."""

import logging

import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable, PublishedWeights

WEIGHTS = PublishedWeights(
    network="TinyNet",
    purpose="this test",
    url="https://example.org/models/tiny-0a1b2c3d.pth",
    megabytes=1,
    key="group.tiny_file",
    choice="group.tiny",
)
EXPECTED = {"a.weight": torch.empty(2, 3, device="meta"), "b.bias": torch.empty(4, device="meta")}


def test_exactly_the_expected_parameters_come_back(tmp_path):
    state = {"a.weight": torch.rand(2, 3), "b.bias": torch.rand(4), "c.weight": torch.rand(1)}
    torch.save(state, tmp_path / "tiny.pth")
    found = WEIGHTS.load(str(tmp_path / "tiny.pth"), EXPECTED)
    assert found.keys() == EXPECTED.keys()
    assert all(torch.equal(found[name], state[name]) for name in found)


def test_messages_name_the_argument_the_network_and_the_parameter(tmp_path):
    torch.save({"a.weight": torch.rand(3, 2)}, tmp_path / "tiny.pth")
    with pytest.raises(InputError) as caught:
        WEIGHTS.load(str(tmp_path / "tiny.pth"), EXPECTED)
    assert str(caught.value) == (
        f"tiny_file {tmp_path / 'tiny.pth'}: a.weight has shape (3, 2), in TinyNet it is (2, 3)"
    )


def test_the_cache_is_looked_into_under_the_published_name(torch_cache):
    torch_cache.mkdir(parents=True)
    state = {"a.weight": torch.rand(2, 3), "b.bias": torch.rand(4)}
    torch.save(state, torch_cache / "tiny-0a1b2c3d.pth")
    assert torch.equal(WEIGHTS.load(None, EXPECTED)["b.bias"], state["b.bias"])


def test_the_log_names_the_file_that_was_read(tmp_path, caplog):
    torch.save({"a.weight": torch.rand(2, 3), "b.bias": torch.rand(4)}, tmp_path / "own.pth")
    with caplog.at_level(logging.INFO, logger="dolens.reconstruction"):
        WEIGHTS.load(str(tmp_path / "own.pth"), EXPECTED)
    (said,) = (record.getMessage() for record in caplog.records)
    assert said == f"TinyNet weights for this test: {tmp_path / 'own.pth'}"


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
