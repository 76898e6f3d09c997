"""The training loss of equation S20 adds squared error, total variation, perceptual error, and
L1.
"""

import difflib
import logging
import math

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.reconstruction.edge_weights import MEAN, STANDARD_DEVIATION, load_edge_weights
from dolens.reconstruction.perceptual import VGG16Features, load_vgg16_weights, perceptual_loss
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable

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
