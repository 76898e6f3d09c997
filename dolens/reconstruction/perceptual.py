"""The perceptual loss: distance between images as the first layers of VGG-16 see them."""

import logging
import os
import socket
from collections.abc import Mapping
from http.client import HTTPException
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models import VGG16_Weights, vgg16

from dolens.errors import InputError

logger = logging.getLogger(__name__)

LAYERS = 15
DOWNLOAD_TIMEOUT_S = 10.0
_URL = VGG16_Weights.IMAGENET1K_V1.url
_FILE_NAME = _URL.rsplit("/", 1)[-1]
# ImageNet's statistics of sRGB values, with which the weights were trained.
_MEAN = (0.485, 0.456, 0.406)
_STANDARD_DEVIATION = (0.229, 0.224, 0.225)


class PerceptualWeightsUnavailable(InputError):
    """No VGG-16 weights were given, cached or to be downloaded; the message says what to do."""


class VGG16Features(nn.Module):
    """The first 15 layers of VGG-16, frozen: the V of equation S20.

    They end with the third convolution of the third block (conv3_3, before its ReLU), at a
    quarter of the resolution.

    Args:
        weights: what `load_vgg16_weights` returns; copied as float32.

    Raises:
        RuntimeError: names or shapes in `weights` that do not fit (as `load_state_dict`).
    """

    mean: Tensor
    standard_deviation: Tensor

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.layers = _empty_layers()
        copies = {name: value.detach().float().clone() for name, value in weights.items()}
        self.layers.load_state_dict(copies, assign=True)
        self.register_buffer("mean", torch.tensor(_MEAN).view(3, 1, 1))
        self.register_buffer("standard_deviation", torch.tensor(_STANDARD_DEVIATION).view(3, 1, 1))
        self.requires_grad_(False)
        self.eval()

    def forward(self, image: Tensor) -> Tensor:
        """Map sRGB images (B, 3, H, W) to features (B, 256, H//4, W//4); H, W at least 4.

        Values are clamped to [0, 1] and normalised as in ImageNet training.  Gradients reach
        the image where it lies inside [0, 1].
        """
        return self.layers((image.clamp(0.0, 1.0) - self.mean) / self.standard_deviation)


def perceptual_loss(features: VGG16Features, restored: Tensor, truth: Tensor) -> Tensor:
    """Return the mean of (V(restored) − V(truth))² over all features, a scalar.

    Args:
        features: V, on the device and in the dtype of the images.
        restored: sRGB values, (B, 3, H, W).
        truth: sRGB values, (B, 3, H, W).
    """
    return functional.mse_loss(features(restored), features(truth))


def load_vgg16_weights(path: str | None) -> dict[str, Tensor]:
    """Find the weights of VGG-16's first 15 layers.

    In order: the file `path`, if one is given; torchvision's file in the torch cache
    (`torch.hub.get_dir()`/checkpoints); torchvision's download into that cache, 528 MB, tried
    once, with 10 s for each connection and each read.

    Args:
        path: a file saved by `torch.save` with a state dict of the whole VGG-16
            (`features.0.weight`, …) or of its features alone (`0.weight`, …); or None.

    Returns:
        Layer parameters by name, `0.weight`, `0.bias`, `2.weight`, …, on the CPU.

    Raises:
        InputError: `path`, or the file in the cache, is missing, unreadable or not VGG-16.
        PerceptualWeightsUnavailable: no path is given, the cache is empty, the download failed.
    """
    if path is not None:
        file = Path(path).expanduser()
        if not file.is_file():
            raise InputError(f"vgg16_weights {file}: no such file")
        return _read(file)
    cached = Path(torch.hub.get_dir()).expanduser() / "checkpoints" / _FILE_NAME
    if not cached.is_file():
        _download(cached)
    return _read(cached)


def _empty_layers() -> nn.Sequential:
    # On the meta device nothing is allocated or initialised: the full VGG-16 is 528 MB.
    with torch.device("meta"):
        return vgg16().features[:LAYERS]


def _read(file: Path) -> dict[str, Tensor]:
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a file of any other kind fails in many ways inside torch.load
        reason = f"cannot be read as PyTorch weights ({type(error).__name__})"
        raise InputError(f"vgg16_weights {file}: {reason}") from error
    if not isinstance(state, Mapping):
        raise InputError(f"vgg16_weights {file}: holds no state dict of VGG-16")
    weights: dict[str, Tensor] = {}
    for name, expected in _empty_layers().state_dict().items():
        value = state.get(f"features.{name}", state.get(name))
        if not isinstance(value, Tensor):
            raise InputError(f"vgg16_weights {file}: no features.{name}; not a VGG-16 state dict")
        if value.shape != expected.shape:
            raise InputError(
                f"vgg16_weights {file}: features.{name} has shape {tuple(value.shape)}, "
                f"in VGG-16 it is {tuple(expected.shape)}"
            )
        weights[name] = value
    return weights


def _download(destination: Path) -> None:
    logger.warning(
        "downloading VGG-16 weights for the perceptual loss (528 MB) from %s to %s",
        _URL,
        destination,
    )
    # torch.hub sets no timeout of its own, and without one an offline machine may hang.
    previous = socket.getdefaulttimeout()
    socket.setdefaulttimeout(DOWNLOAD_TIMEOUT_S)
    try:
        os.makedirs(destination.parent, exist_ok=True)
        # torchvision's file names end in the first digits of the file's SHA-256.
        digest = destination.stem.rsplit("-", 1)[-1]
        torch.hub.download_url_to_file(_URL, str(destination), hash_prefix=digest, progress=False)
    except (OSError, HTTPException, RuntimeError) as error:  # network, disk, or a wrong hash
        reason = " ".join(str(error).split()) or type(error).__name__
        raise PerceptualWeightsUnavailable(
            "no VGG-16 weights for the perceptual loss: give loss.vgg16_weights=FILE; or put "
            f"{_FILE_NAME} into {destination.parent}; or allow the download of {_URL} "
            f"(it failed: {reason})"
        ) from error
    finally:
        socket.setdefaulttimeout(previous)
