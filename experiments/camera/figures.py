"""Figures of a camera: its images, its point spread functions, and its layout."""

import copy
from collections.abc import Mapping
from functools import partial

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.reconstruction import evaluating
from dolens.experiments.experiment import Figures
from dolens.plotting import comparison_figure, layout_figure, psf_figure
from dolens.reconstruction import psnr_db
from dolens.sensor.colour import linear_to_srgb

_PUPIL_SAMPLES = 96  # along each side of the pupil


def camera_figures(camera: Camera, crops: Mapping[str, Tensor], stage: str) -> Figures:
    """Return `images`, `point_spread_functions` and `layout`.

    Args:
        camera: as it is.
        crops: stage → a texture (1, 3, h, w), linear light.
        stage: the stage whose crop is shown, `val` or `test`.
    """
    return {
        "images": partial(_images, camera, crops, stage),
        "point_spread_functions": partial(_point_spread_functions, camera),
        "layout": partial(_layout, camera),
    }


@torch.no_grad()
def _images(camera: Camera, crops: Mapping[str, Tensor], stage: str) -> Figure:
    """Draw truth, raw and restored images; the same stage shows the same ones again."""
    # In evaluation mode: the network is shown as it is measured, and its statistics stay.
    with evaluating(camera.network):
        taken, functions = camera.take(camera.variables(), crops[stage], stage, 0)
        restored = camera.restore(taken, functions).clamp(0.0, 1.0)
    truth, raw, restored = (
        images.cpu()[0] for images in (taken.truth, linear_to_srgb(taken.raw), restored)
    )
    quality = {"raw": psnr_db(raw, truth).tolist(), "restored": psnr_db(restored, truth).tolist()}
    return comparison_figure(truth, raw, restored, camera.views.labels(), quality)


@torch.no_grad()
def _point_spread_functions(camera: Camera) -> Figure:
    views = camera.views
    functions = views.point_spread_functions(camera.lens, camera.variables(), _PUPIL_SAMPLES)
    return psf_figure(
        functions.cpu(), views.psf_labels(), views.sensor.pixel_pitch, "Point spread functions"
    )


def _layout(camera: Camera) -> Figure:
    return layout_figure(
        copy.deepcopy(camera.lens).cpu(),
        object_distance=camera.views.object_distance,
        title=camera.lens.name,
    )
