"""A backbone extracts features at strides 1, 2, …, 32 by a classifier's convolutional layers."""

import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from dolens.errors import InputError
from dolens.reconstruction.torchvision_weights import (
    IMAGENET_MEAN,
    IMAGENET_STANDARD_DEVIATION,
    PretrainedWeightsUnavailable,
    PublishedWeights,
    published_address,
)


@dataclass(frozen=True)
class Architecture:
    """An `Architecture` is a classifier whose layers serve as a backbone.

    Attributes:
        layers: (width multiplier) → its layers in order, named as in torchvision's state dict
            and randomly initialised.
        stage_ends: numbers of the layers that end the stages of stride 2, 4, 8, 16 and 32.
        first_convolution: its name among the layers.
        mean: of the sRGB values its weights were trained with, by colour.
        standard_deviation: likewise.
        published: the trained weights, those of width 1.
    """

    layers: Callable[[float], nn.Sequential]
    stage_ends: tuple[int, ...]
    first_convolution: str
    mean: tuple[float, float, float]
    standard_deviation: tuple[float, float, float]
    published: PublishedWeights

    def stages(self, stages: int, width_multiplier: float) -> nn.Sequential:
        """Return the layers up to stride 2**stages.

        Raises:
            InputError: no such number of stages or no such width.
        """
        if stages not in range(2, len(self.stage_ends) + 1):
            raise InputError(f"stages={stages}: must be from 2 to {len(self.stage_ends)}")
        return self.layers(width_multiplier)[: self.stage_ends[stages - 1] + 1]

    def trained_parameters(self, stages: int, width_multiplier: float) -> dict[str, Tensor]:
        """Return names and shapes of the trained weights, as tensors on the meta device."""
        with torch.device("meta"):
            state = self.stages(stages, width_multiplier).state_dict()
        return {name: value for name, value in state.items() if not name.endswith("_tracked")}


def _mobilenet_v2_layers(width_multiplier: float) -> nn.Sequential:
    if not (width_multiplier > 0 and math.isfinite(width_multiplier)):
        raise InputError(f"width_multiplier={width_multiplier}: must be positive and finite")
    from torchvision.models import mobilenet_v2

    # The last layer, which only the classifier needs, stays out.
    layers = mobilenet_v2(width_mult=width_multiplier).features[:-1]
    _initialise(layers)
    for block in layers[1:]:
        projection = block.conv[-2]  # before its normalisation; no ReLU follows
        nn.init.kaiming_normal_(projection.weight, nonlinearity="linear")
        if block.use_res_connect:
            # Residual blocks begin as the identity, or without normalisation the values would
            # grow from block to block (Zhang et al., Fixup, 2019).
            nn.init.zeros_(projection.weight)
    return layers


def _googlenet_layers(width_multiplier: float) -> nn.Sequential:
    from torchvision.models import googlenet

    if width_multiplier != 1:
        raise InputError(f"width_multiplier={width_multiplier}: googlenet has only width 1")
    network = googlenet(aux_logits=False, init_weights=False)
    classifier = ("avgpool", "dropout", "fc")
    layers = nn.Sequential(
        OrderedDict((n, part) for n, part in network.named_children() if n not in classifier)
    )
    _initialise(layers)
    return layers


def _initialise(layers: nn.Sequential) -> None:
    # He et al. 2015, which keeps the variance of values from layer to layer without any
    # normalisation; torchvision's own rely on it, and shrink them.
    for part in layers.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, nonlinearity="relu")


ARCHITECTURES = {
    "mobilenet_v2": Architecture(
        layers=_mobilenet_v2_layers,
        stage_ends=(1, 3, 6, 13, 17),
        first_convolution="0.0",
        mean=IMAGENET_MEAN,
        standard_deviation=IMAGENET_STANDARD_DEVIATION,
        published=PublishedWeights(
            network="MobileNetV2",
            purpose="the network's backbone",
            # Not the second edition: it was trained with label smoothing, whose features
            # transfer worse (Kornblith et al. 2021).
            address=partial(published_address, "MobileNet_V2_Weights.IMAGENET1K_V1"),
            megabytes=14,
            key="network.weights_file",
            choice="network.weights",
            prefix="features.",
        ),
    ),
    # The Inception network whose convolutions are all padded, so that its strides come out even.
    "googlenet": Architecture(
        layers=_googlenet_layers,
        stage_ends=(0, 3, 6, 12, 15),
        first_convolution="conv1.conv",
        # Its weights were ported from TensorFlow, where values run from −1 to 1.
        mean=(0.5, 0.5, 0.5),
        standard_deviation=(0.5, 0.5, 0.5),
        published=PublishedWeights(
            network="GoogLeNet",
            purpose="the network's backbone",
            address=partial(published_address, "GoogLeNet_Weights.IMAGENET1K_V1"),
            megabytes=50,
            key="network.weights_file",
            choice="network.weights",
        ),
    ),
}


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
