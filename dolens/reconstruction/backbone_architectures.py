"""The classifiers of torchvision that may be a backbone are listed, with their layers and
strides.
"""

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torchvision.models import GoogLeNet_Weights, MobileNet_V2_Weights, googlenet, mobilenet_v2

from dolens.errors import InputError
from dolens.reconstruction.torchvision_weights import (
    IMAGENET_MEAN,
    IMAGENET_STANDARD_DEVIATION,
    PublishedWeights,
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
            url=MobileNet_V2_Weights.IMAGENET1K_V1.url,
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
            url=GoogLeNet_Weights.IMAGENET1K_V1.url,
            megabytes=50,
            key="network.weights_file",
            choice="network.weights",
        ),
    ),
}
