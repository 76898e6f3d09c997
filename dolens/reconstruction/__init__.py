"""From the sensor image to the picture: networks, deconvolution, losses, image quality."""

from dolens.reconstruction.backbones import Backbone, load_backbone
from dolens.reconstruction.feature_pyramid import FeaturePyramid
from dolens.reconstruction.field_coordinates import field_channels
from dolens.reconstruction.losses import (
    RestorationLoss,
    mean_absolute_error,
    mean_squared_error,
    total_variation,
)
from dolens.reconstruction.perceptual import VGG16Features, load_vgg16_weights, perceptual_loss
from dolens.reconstruction.quality import psnr_db, structural_similarity
from dolens.reconstruction.restoration import (
    FeaturePyramidRestoration,
    Restoration,
    UNetRestoration,
    WienerUNetRestoration,
)
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener import wiener_deconvolve

__all__ = [
    "Backbone",
    "FeaturePyramid",
    "FeaturePyramidRestoration",
    "PretrainedWeightsUnavailable",
    "Restoration",
    "RestorationLoss",
    "UNet",
    "UNetRestoration",
    "VGG16Features",
    "WienerUNetRestoration",
    "field_channels",
    "load_backbone",
    "load_vgg16_weights",
    "mean_absolute_error",
    "mean_squared_error",
    "perceptual_loss",
    "psnr_db",
    "structural_similarity",
    "total_variation",
    "wiener_deconvolve",
]
