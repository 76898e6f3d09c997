"""No test here reaches the network or the user's torch cache."""

from urllib.error import URLError

import pytest
import torch
from torch import nn

# VGG-16's first seven convolutions: number of the layer, channels in, channels out.
CONVOLUTIONS = [
    (0, 3, 64),
    (2, 64, 64),
    (5, 64, 128),
    (7, 128, 128),
    (10, 128, 256),
    (12, 256, 256),
    (14, 256, 256),
]


@pytest.fixture(autouse=True)
def torch_cache(tmp_path, monkeypatch):
    """An empty torch cache; a download fails as on an offline machine."""

    def fail(*args, **kwargs):
        raise URLError("no network in tests")

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "download_url_to_file", fail)
    return tmp_path / "hub" / "checkpoints"


@pytest.fixture(autouse=True)
def _one_thread(one_thread):
    """Networks of many small layers."""


@pytest.fixture(scope="session")
def vgg16_state():
    """A features-only state dict with VGG-16's shapes and random values."""
    generator = torch.Generator().manual_seed(16)
    state = {}
    for number, before, after in CONVOLUTIONS:
        weight = torch.empty(after, before, 3, 3)
        nn.init.kaiming_normal_(weight, generator=generator)
        state[f"{number}.weight"] = weight
        state[f"{number}.bias"] = 0.1 * torch.randn(after, generator=generator)
    return state


@pytest.fixture(scope="session")
def vgg16_file(vgg16_state, tmp_path_factory):
    file = tmp_path_factory.mktemp("vgg16") / "features.pth"
    torch.save(vgg16_state, file)
    return str(file)
