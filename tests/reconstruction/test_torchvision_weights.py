"""What test_perceptual.py does not show of the search for weights with VGG-16's."""

import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction.torchvision_weights import PublishedWeights

WEIGHTS = PublishedWeights(
    network="TinyNet",
    purpose="this test",
    url="https://example.org/models/tiny-0a1b2c3d.pth",
    megabytes=1,
    key="group.tiny_file",
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
