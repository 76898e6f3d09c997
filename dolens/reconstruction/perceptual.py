"""The perceptual loss is the distance between images in the features of VGG-16's first layers."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models import VGG16_Weights, vgg16

from dolens.reconstruction.torchvision_weights import (
    IMAGENET_MEAN,
    IMAGENET_STANDARD_DEVIATION,
    PublishedWeights,
)

LAYERS = 15
VGG16 = PublishedWeights(
    network="VGG-16",
    purpose="the perceptual loss",
    url=VGG16_Weights.IMAGENET1K_V1.url,
    megabytes=528,
    key="loss.vgg16_weights",
    choice="loss.perceptual",
    prefix="features.",
)


class VGG16Features(nn.Module):
    """The first 15 layers of VGG-16, frozen, are the feature extractor V of equation S20.

    They end with the third convolution of the third block (conv3_3, before its ReLU), at a
    quarter of the resolution.

    Args:
        weights: from `load_vgg16_weights` or `load_edge_weights`; copied as float32.
        mean: of R, G, B in [0, 1], which the weights were trained with; default: ImageNet's.
        standard_deviation: likewise.

    Raises:
        RuntimeError: names or shapes in `weights` that do not fit (as `load_state_dict`).
    """

    mean: Tensor
    standard_deviation: Tensor

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        mean: Sequence[float] = IMAGENET_MEAN,
        standard_deviation: Sequence[float] = IMAGENET_STANDARD_DEVIATION,
    ) -> None:
        super().__init__()
        self.layers = _empty_layers()
        copies = {name: value.detach().float().clone() for name, value in weights.items()}
        self.layers.load_state_dict(copies, assign=True)
        self.register_buffer("mean", torch.tensor(mean).view(3, 1, 1))
        deviation = torch.tensor(standard_deviation).view(3, 1, 1)
        self.register_buffer("standard_deviation", deviation)
        self.requires_grad_(False)
        self.eval()

    def forward(self, image: Tensor) -> Tensor:
        """Map sRGB images (B, 3, H, W) to features (B, 256, H//4, W//4); H, W at least 4.

        Values are clamped to [0, 1] and normalised as in the weights' training.  Gradients reach
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


def load_vgg16_weights(path: str | None, download: bool = False) -> dict[str, Tensor]:
    """Load the weights of VGG-16's first 15 layers; see `PublishedWeights.load`.

    Args:
        path: a file saved by `torch.save` with a state dict of the whole VGG-16
            (`features.0.weight`, …) or of its features alone (`0.weight`, …); or None, for the
            torch cache.
        download: whether 528 MB may be downloaded where there is no file.

    Returns:
        Layer parameters by name, `0.weight`, `0.bias`, `2.weight`, …, on the CPU.

    Raises:
        InputError: `path`, or the file in the cache, is missing, unreadable or not VGG-16.
        PretrainedWeightsUnavailable: no path is given, the cache is empty, and the download is not
            allowed or failed.
    """
    return VGG16.load(path, _empty_layers().state_dict(), download)


def _empty_layers() -> nn.Sequential:
    # On the meta device nothing is allocated or initialised: the full VGG-16 is 528 MB.
    with torch.device("meta"):
        return vgg16().features[:LAYERS]
