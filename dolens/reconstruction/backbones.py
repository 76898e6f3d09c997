"""A backbone extracts features at strides 1, 2, …, 32 by a classifier's convolutional layers."""

import logging
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from dolens.errors import InputError
from dolens.reconstruction.backbone_architectures import ARCHITECTURES, Architecture
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable, PublishedWeights

logger = logging.getLogger(__name__)

COLORS = 3
WEIGHTS_CHOICES = ("auto", "imagenet", "download", "none")


class Backbone(nn.Module):
    """A `Backbone` holds the first stages of a classifier, and returns the last features of each.

    There is no normalisation while training.  Over a batch it would be noisy, batches being
    small, and differ from evaluation; over an image's area (instance or group normalisation) it
    would take absolute levels away and differ between the patches of training and whole images.
    Batch normalisation with the statistics of ImageNet, which trained weights expect, is a
    constant affine map, and is folded into the convolution before it.  So trained and random
    backbones have the same parameters, and either's checkpoint fits the other.

    Args:
        architecture: one of `ARCHITECTURES`.
        in_channels: three colours, sRGB-encoded, and any others after them, of order one.
        stages: how many, from 2 to 5; the last has stride 2**stages.
        width_multiplier: of the layers' channels.
        weights: trained parameters and statistics, by the names that
            `Architecture.trained_parameters` lists; None for a random start.  The weights of
            further input channels start at zero beside trained ones: the features begin as they
            were trained to be.

    Attributes:
        channels: of the features at stride 1, 2, 4, …, 2**stages.
        pretrained: whether it began with `weights`.

    Raises:
        InputError: no such `in_channels`, `stages` or `width_multiplier`.
        RuntimeError: names or shapes in `weights` that do not fit (as `load_state_dict`).
    """

    mean: Tensor
    standard_deviation: Tensor

    def __init__(
        self,
        architecture: Architecture,
        in_channels: int = COLORS,
        stages: int = 5,
        width_multiplier: float = 1.0,
        weights: Mapping[str, Tensor] | None = None,
    ) -> None:
        super().__init__()
        if in_channels < COLORS:
            raise InputError(f"in_channels={in_channels}: must be at least {COLORS}, the colours")
        self.pretrained = weights is not None
        self.stage_ends = architecture.stage_ends[:stages]
        self.layers = architecture.stages(stages, width_multiplier)
        if weights is not None:
            self.layers.load_state_dict(weights)
        self._fold_batch_normalization()
        further = in_channels - COLORS
        name = architecture.first_convolution
        narrow = self.layers.get_submodule(name)
        assert isinstance(narrow, nn.Conv2d)
        first = _widened(narrow, further, zero=self.pretrained)
        self.layers.set_submodule(name, first)
        mean = (*architecture.mean, *[0.0] * further)
        deviation = (*architecture.standard_deviation, *[1.0] * further)
        self.register_buffer("mean", _column(mean), persistent=False)
        self.register_buffer("standard_deviation", _column(deviation), persistent=False)
        with torch.no_grad():
            features = self(torch.zeros(1, in_channels, self.stride, self.stride))
        self.channels = tuple(values.shape[1] for values in features)

    @property
    def stride(self) -> int:
        """Return the stride of the last stage."""
        return 2 ** len(self.stage_ends)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Map (B, in_channels, H, W) to features (B, channels[k], H/2ᵏ, W/2ᵏ), k = 0 … stages.

        Those at stride 1 are the image itself, standardised as the weights were trained with.
        H and W are multiples of `stride`.
        """
        values = (image - self.mean) / self.standard_deviation
        features = [values]
        for number, layer in enumerate(self.layers):
            values = layer(values)
            if number in self.stage_ends:
                features.append(values)
        return features

    def _fold_batch_normalization(self) -> None:
        kinds = (nn.Conv2d, nn.BatchNorm2d)
        names = [name for name, part in self.layers.named_modules() if isinstance(part, kinds)]
        # Both architectures follow each convolution by its normalisation.
        for before, after in zip(names[::2], names[1::2], strict=True):
            convolution = self.layers.get_submodule(before)
            norm = self.layers.get_submodule(after)
            assert isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
            assert norm.running_mean is not None and norm.running_var is not None
            folded = fuse_conv_bn_weights(
                convolution.weight,
                convolution.bias,
                norm.running_mean,
                norm.running_var,
                norm.eps,
                norm.weight,
                norm.bias,
            )
            # Parameters anew: torch would leave a bias that was not there before untrained.
            weight, bias = folded
            convolution.weight = nn.Parameter(weight.detach())
            convolution.bias = nn.Parameter(bias.detach())
            self.layers.set_submodule(after, nn.Identity())


def load_backbone(
    name: str,
    in_channels: int = COLORS,
    stages: int = 5,
    width_multiplier: float = 1.0,
    weights: str = "auto",
    weights_file: str | None = None,
) -> Backbone:
    """Build a backbone, with ImageNet's weights where they are wanted and available.

    Args:
        name: "mobilenet_v2" or "googlenet".
        in_channels: see `Backbone`.
        stages: see `Backbone`.
        width_multiplier: see `Backbone`.
        weights: "imagenet" requires trained weights, from a file or the torch cache; "auto" starts
            at random, with a warning, where there are none; "download" requires them, and downloads
            them where there are none; "none" starts at random.  Only "download" uses the network.

    Rarely needed:
        weights_file: file of trained weights; see `PublishedWeights.load`.

    Raises:
        InputError: another word for `name` or `weights`, a number out of range, a wrong file,
            or a file with `weights="none"`.
        PretrainedWeightsUnavailable: `weights` requires them and none were found.
    """
    if name not in ARCHITECTURES:
        raise InputError(f"backbone={name}: allowed are {', '.join(ARCHITECTURES)}")
    if weights not in WEIGHTS_CHOICES:
        raise InputError(f"weights={weights}: allowed are {', '.join(WEIGHTS_CHOICES)}")
    if weights == "none" and weights_file is not None:
        raise InputError(f"weights_file={weights_file}: not read with weights=none; use imagenet")
    architecture = ARCHITECTURES[name]
    found = None
    if weights != "none":
        try:
            expected = architecture.trained_parameters(stages, width_multiplier)
            if weights_file is None and width_multiplier != 1:
                raise _unpublished(architecture.published, width_multiplier)
            found = architecture.published.load(weights_file, expected, weights == "download")
        except PretrainedWeightsUnavailable as error:
            if weights != "auto":
                raise
            logger.warning("THE BACKBONE STARTS FROM RANDOM WEIGHTS: %s", error)
    return Backbone(architecture, in_channels, stages, width_multiplier, found)


def _unpublished(
    published: PublishedWeights, width_multiplier: float
) -> PretrainedWeightsUnavailable:
    return PretrainedWeightsUnavailable(
        f"no {published.network} weights are published for width_multiplier="
        f"{width_multiplier}: give {published.key}=FILE or width_multiplier=1"
    )


def _column(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values).view(-1, 1, 1)


def _pair(sides: Any) -> tuple[int, int]:
    rows, columns = sides
    return rows, columns


def _widened(convolution: nn.Conv2d, further: int, zero: bool) -> nn.Conv2d:
    if further == 0:
        return convolution
    wider = nn.Conv2d(
        convolution.in_channels + further,
        convolution.out_channels,
        _pair(convolution.kernel_size),
        _pair(convolution.stride),
        _pair(convolution.padding),
    )
    assert wider.bias is not None and convolution.bias is not None
    with torch.no_grad():
        wider.bias.copy_(convolution.bias)
        if zero:
            wider.weight.zero_()
            wider.weight[:, : convolution.in_channels] = convolution.weight
        else:
            nn.init.kaiming_normal_(wider.weight, nonlinearity="relu")
    return wider
