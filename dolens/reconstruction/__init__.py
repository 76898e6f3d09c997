"""From the sensor image to the picture: networks, deconvolution, losses, image quality."""

from dolens.reconstruction.losses import (
    RestorationLoss,
    mean_absolute_error,
    mean_squared_error,
    total_variation,
)
from dolens.reconstruction.perceptual import VGG16Features, load_vgg16_weights, perceptual_loss
from dolens.reconstruction.quality import psnr_db, structural_similarity
from dolens.reconstruction.restoration import (
    Restoration,
    UNetRestoration,
    WienerUNetRestoration,
)
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener import wiener_deconvolve

__all__ = [
    "PretrainedWeightsUnavailable",
    "Restoration",
    "RestorationLoss",
    "UNet",
    "UNetRestoration",
    "VGG16Features",
    "WienerUNetRestoration",
    "load_vgg16_weights",
    "mean_absolute_error",
    "mean_squared_error",
    "perceptual_loss",
    "psnr_db",
    "structural_similarity",
    "total_variation",
    "wiener_deconvolve",
]
