"""Figures of a camera: its images, its point spread functions, and its layout."""

import copy
import math
from collections.abc import Mapping
from functools import partial

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.photograph_scores import PhotographScores
from dolens.experiments.camera.reconstruction import evaluating
from dolens.experiments.camera.views.base import Shot, Views
from dolens.experiments.experiment import Figures
from dolens.optics.paraxial import first_order
from dolens.plotting import comparison_figure, layout_figure, psf_figure
from dolens.plotting.layout import layout_title, lens_title, optics_text, shown_name
from dolens.plotting.style import number_text
from dolens.reconstruction import psnr_db
from dolens.reconstruction.likelihood import depth_picture, depth_probabilities
from dolens.reconstruction.opponent_wiener import functions_of_each
from dolens.sensor.colour import linear_to_srgb

_PUPIL_SAMPLES = 96  # along each side of the pupil
# A window of point spread functions is doubled until it holds this share of each, up to so many
# pixels along each side.
_HELD, _LARGEST_WINDOW = 0.998, 1025
# Zones of a sensor that are not shares of its field.
_ZONES = {"axis": "on the axis", "full": "edge of the field", "field": "anywhere in the field"}


def camera_figures(
    camera: Camera,
    crops: Mapping[str, Tensor],
    stage: str,
    scores: PhotographScores | None = None,
) -> Figures:
    """Return `images`, `point_spread_functions` and `layout`.

    Args:
        camera: as it is.
        crops: stage → a texture (1, 3, h, w), linear light.
        stage: the stage whose crop is shown, `val` or `test`.
        scores: of all photographs of the stage, for the title; None where there are none yet.
    """
    return {
        "images": partial(_images, camera, crops, stage, scores),
        "point_spread_functions": partial(_point_spread_functions, camera),
        "layout": partial(_layout, camera),
    }


@torch.no_grad()
def _images(
    camera: Camera, crops: Mapping[str, Tensor], stage: str, scores: PhotographScores | None
) -> Figure:
    """Draw truth, raw and restored images; the same stage shows the same ones again."""
    # In evaluation mode: the network is shown as it is measured, and its statistics stay.
    with evaluating(camera.network):
        taken, functions = camera.take(camera.variables(), Shot(crops[stage], stage, 0))
        restored = camera.restore(taken, functions).clamp(0.0, 1.0)
        depths = _depths(camera, taken, functions)
    truth, raw, restored = (
        images.cpu()[0] for images in (taken.truth, linear_to_srgb(taken.raw), restored)
    )
    quality = {"raw": psnr_db(raw, truth).tolist(), "restored": psnr_db(restored, truth).tolist()}
    kind = {"val": "validation", "test": "test"}[stage]
    title = lens_title(copy.deepcopy(camera.lens).cpu(), camera.views.object_distance)
    note = f"One crop of one {kind} photograph, with the PSNR of this crop."
    if scores is not None:
        found = scores.metrics["psnr_db"]
        mean, count = float(found.mean()), len(found)
        note += f" Restored, {count} photographs and all views have {mean:.2f} dB on average."
    note += " Pictures are display-encoded (sRGB), clipped to [0, 1] and not interpolated."
    labels = [view_name(label) for label in camera.views.labels()]
    return comparison_figure(truth, raw, restored, labels, quality, title, depths, note)


def _depths(camera: Camera, taken: Views, functions: Tensor | None) -> dict[str, Tensor]:
    """Return what a network that chooses by depth saw of it, (V, 3, H, W), by what it is called."""
    views = camera.views
    depths = getattr(views, "psf_depths", None) or views.scene.depths
    chooses = getattr(camera.network, "by_depth", False) and len(depths) > 1
    if not chooses or functions is None:
        return {}
    images = taken.given[: taken.raw.shape[1]]
    pairs = zip(images.split(1), functions_of_each(images, functions), strict=True)
    found = torch.cat([depth_probabilities(*pair, *camera.noise()) for pair in pairs])
    name = f"depth, black {_metres(max(depths))}, white {_metres(min(depths))}"
    return {name: depth_picture(found, depths).cpu()}


@torch.no_grad()
def _point_spread_functions(camera: Camera) -> Figure:
    views = camera.views
    functions = _whole_functions(camera)
    lens = copy.deepcopy(camera.lens).cpu()
    optics = optics_text(lens.system(), lens.primary_wavelength, views.object_distance)
    return psf_figure(
        functions.cpu().reshape(-1, *functions.shape[-3:]),  # of readouts one after the other
        [view_name(label) for label in views.psf_labels()],
        views.sensor.pixel_pitch,
        f"{shown_name(lens)}: {optics}\nPSFs {views.psf_place}",
    )


def _whole_functions(camera: Camera) -> Tensor:
    """Return point spread functions in a window that cuts next to nothing off."""
    lens, views = camera.lens.with_values(camera.variables()), camera.views
    found = views.point_spread_functions(lens, _PUPIL_SAMPLES)
    if getattr(views, "psf_diffraction", "none") == "wave":
        return found  # a diffractive element's other orders fill no window
    while True:
        size = 2 * found.shape[-1] - 1
        if size > _LARGEST_WINDOW:
            return found
        wider = views.point_spread_functions(lens, _PUPIL_SAMPLES, size=size)
        held = found.sum((-3, -2, -1)) >= _HELD * wider.sum((-3, -2, -1))
        if bool(held.all()):
            return found
        found = wider


def _layout(camera: Camera) -> Figure:
    """Draw the section along the sensor's diagonal, with the fields of the camera's views."""
    lens, views = copy.deepcopy(camera.lens).cpu(), camera.views
    sensor, distance = views.image_sensor, views.object_distance
    diagonal = math.hypot(sensor.height, sensor.width) * sensor.pixel_pitch
    system = lens.system()
    found = first_order(system, lens.primary_wavelength, distance)
    height = 0.5 * diagonal / abs(float(found.magnification))
    away = distance + float(found.entrance_pupil.z)
    angles = [math.degrees(math.atan2(share * height, away)) for share in views.field_shares()]
    size = f"{number_text(sensor.width * sensor.pixel_pitch)} × "
    size += f"{number_text(sensor.height * sensor.pixel_pitch)} mm"
    title = layout_title(lens, system, lens.primary_wavelength, distance)
    return layout_figure(
        lens,
        lens.primary_wavelength,
        [float(f"{angle:.3g}") for angle in angles],
        object_distance=distance,
        title=f"{title}\nobject at {_metres(distance)}, diagonal of the sensor of {size}",
        sensor=diagonal,
    )


def _metres(distance: float) -> str:
    """Return a distance in mm as `6 m`, or in mm below a metre."""
    if distance >= 1000.0:
        return f"{number_text(1e-3 * distance)} m"
    return f"{number_text(distance)} mm"


def view_name(label: str) -> str:
    """Return `8 m` for the label `8m` of a depth, and `0.7 of the field` for that of a zone."""
    state, _, own = label.rpartition(", ")
    if state:  # of a lens that is exposed in several
        return f"{state}, {view_name(own)}"
    number = label.removesuffix("m")
    if number.replace(".", "").isdigit():
        return f"{number} m" if number != label else f"{label} of the field"
    return _ZONES.get(label, label)
