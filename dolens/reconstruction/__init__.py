"""Images are reconstructed from sensor data by networks and deconvolution, with losses and quality
metrics.
"""

from dolens.reconstruction.adversarial import (
    GlobalDiscriminator,
    PatchDiscriminator,
    RelativisticDiscriminators,
    relativistic_discriminator_loss,
    relativistic_generator_loss,
)
from dolens.reconstruction.backbones import Backbone, load_backbone
from dolens.reconstruction.feature_pyramid import FeaturePyramid
from dolens.reconstruction.feature_wiener import FeatureWienerRestoration
from dolens.reconstruction.general import GeneralRestoration
from dolens.reconstruction.losses import (
    RestorationLoss,
    VGG16Features,
    load_vgg16_weights,
    mean_absolute_error,
    mean_squared_error,
    perceptual_loss,
    total_variation,
)
from dolens.reconstruction.nafnet import NAFNet, NAFNetRestoration, WienerNAFNetRestoration
from dolens.reconstruction.opponent_wiener import opponent_wiener_deconvolve
from dolens.reconstruction.quality import psnr_db, structural_similarity
from dolens.reconstruction.restoration import (
    FeaturePyramidRestoration,
    Restoration,
    UNetRestoration,
    WienerUNetRestoration,
    field_channels,
)
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.unrolled_splitting import UnrolledSplittingRestoration
from dolens.reconstruction.untrained import (
    UntrainedRestoration,
    WienerBM3DRestoration,
    WienerTVRestoration,
)
from dolens.reconstruction.whole_pictures import restore
from dolens.reconstruction.wiener import wiener_deconvolve

__all__ = [
    "Backbone",
    "FeaturePyramid",
    "FeaturePyramidRestoration",
    "FeatureWienerRestoration",
    "GeneralRestoration",
    "GlobalDiscriminator",
    "NAFNet",
    "NAFNetRestoration",
    "PatchDiscriminator",
    "PretrainedWeightsUnavailable",
    "RelativisticDiscriminators",
    "Restoration",
    "RestorationLoss",
    "UNet",
    "UNetRestoration",
    "UnrolledSplittingRestoration",
    "UntrainedRestoration",
    "VGG16Features",
    "WienerBM3DRestoration",
    "WienerNAFNetRestoration",
    "WienerTVRestoration",
    "WienerUNetRestoration",
    "field_channels",
    "load_backbone",
    "load_vgg16_weights",
    "mean_absolute_error",
    "mean_squared_error",
    "opponent_wiener_deconvolve",
    "perceptual_loss",
    "psnr_db",
    "relativistic_discriminator_loss",
    "relativistic_generator_loss",
    "restore",
    "structural_similarity",
    "total_variation",
    "wiener_deconvolve",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
