"""Scenes are restored by the functions of the design, of the fitted lens and of the true one."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.alignment.chart import CHART_POSE, SENSOR_POSE, Chart
from dolens.alignment.chart_model import BLUR, ChartModel, ChartRays
from dolens.alignment.chart_photons import ChartLight, TrueCamera, photographed
from dolens.experiments.data.package_photographs import TEST, VALIDATION, read_installed
from dolens.experiments.poses.chart_simulation import Restoration
from dolens.reconstruction.wiener import transfer_function, wiener_deconvolve
from dolens.rendering.psf import bin_rays
from dolens.sensor.colour import srgb_to_linear
from dolens.sensor.noise import generator_of

# A scene that is far away, mm; its points are so small that their images are a tenth of a pixel.
_FAR, _POINT = 1e6, 0.1
# Rays of a function, dense in every pixel, and the part of a pixel that each is spread over.
_RINGS, _SPOKES, _SUBPIXELS = 20, 64, 4
# Photons that find a function's place, and how far off it may be, mm.
_FEW, _SEEN = 2e4, 1.5
# Noise over signal at the Nyquist frequency, of Wiener's filter.
RATIOS = tuple(10.0 ** (0.25 * step) for step in range(-16, 9))
ARMS = ("design", "fitted", "true")


class Judged(NamedTuple):
    """Peak signal-to-noise ratios of one camera's restored photographs, dB.

    Attributes:
        tuning: (arms, fields, ratios), on photographs for the choice of a ratio.
        test: (arms, fields, ratios), on others.
    """

    tuning: Tensor
    test: Tensor


def judged(
    model: ChartModel,
    settings: Restoration,
    numbers: Mapping[str, Tensor],
    camera: TrueCamera,
    wavelengths: Sequence[float],
    generator: torch.Generator,
) -> Judged:
    """Take photographs of scenes through a true camera, and restore them.

    Args:
        model: of the camera.
        settings: of the scenes.
        numbers: `design` and `fitted` parameters.
        camera: that takes them.
        wavelengths: nm, of the light.
        generator: of photons and noise.
    """
    functions = {
        name: torch.stack(
            [_by_rays(model, settings, values, wavelengths, field) for field in settings.fields]
        )
        for name, values in numbers.items()
    }
    functions["true"] = torch.stack(
        [
            _by_photons(model, settings, camera, wavelengths, field, generator)
            for field in settings.fields
        ]
    )
    parts = []
    for names in (VALIDATION, TEST):
        scenes = torch.stack([_scene(name, settings.crop) for name in names])
        parts.append(_restored(functions, scenes, settings, generator))
    return Judged(*parts)


def _restored(
    functions: Mapping[str, Tensor],
    scenes: Tensor,
    settings: Restoration,
    generator: torch.Generator,
) -> Tensor:
    """Return mean PSNRs (arms, fields, ratios), dB, of scenes (S, H, W)."""
    margin = settings.size // 2
    found = torch.zeros(len(ARMS), len(settings.fields), len(RATIOS), dtype=torch.float64)
    for field, function in enumerate(functions["true"]):
        transfer = transfer_function(function, *scenes.shape[-2:])
        blurred = torch.fft.irfft2(torch.fft.rfft2(scenes) * transfer, s=scenes.shape[-2:])
        noise = torch.randn(blurred.shape, generator=generator, dtype=blurred.dtype)
        photograph = blurred + settings.noise * noise
        for arm, name in enumerate(ARMS):
            for place, ratio in enumerate(RATIOS):
                own = functions[name][field][None]
                restored = wiener_deconvolve(photograph[:, None], own, ratio, margin)[:, 0]
                apart = (restored.clamp(0.0, 1.0) - scenes)[..., margin:-margin, margin:-margin]
                psnr = -10.0 * torch.log10(apart.square().mean((-2, -1)))
                found[arm, field, place] = psnr.mean()
    return found


def _scene(name: str, side: int) -> Tensor:
    """Return the middle of a photograph, grey, linear light, (side, side)."""
    grey = srgb_to_linear(read_installed(name).encoded.double() / 255.0).mean(0)
    top, left = ((length - side) // 2 for length in grey.shape)
    return grey[top : top + side, left : left + side]


def _far_point(pitch: float, focal: float) -> Chart:
    """Return a chart of one mark, small in the image of a lens of a focal length (mm)."""
    return Chart(_FAR, 1, 1, _FAR, _POINT * pitch * _FAR / focal)


def _focal(model: ChartModel) -> float:
    """Return the focal length of the lens as designed, mm."""
    lens = model.rays.lens
    return float(lens.first_order(lens.primary_wavelength).efl.detach())


def _pose(field: Sequence[float]) -> tuple[float, ...]:
    """Return where the mark stands for a field (x, y) in degrees; see `CHART_POSE`."""
    x, y = (-_FAR * math.tan(math.radians(angle)) for angle in field)
    return (x, y, 0.0, 0.0, 0.0, 0.0)


def _by_rays(
    model: ChartModel,
    settings: Restoration,
    numbers: Tensor,
    wavelengths: Sequence[float],
    field: Sequence[float],
) -> Tensor:
    """Return a function (K, K) by the model's rays, about its centroid."""
    rays = ChartRays(
        model.rays.lens, _far_point(model.pitch, _focal(model)), tuple(wavelengths), _RINGS, _SPOKES
    )
    own = ChartModel(rays, model.of_lens, (settings.plane,), model.pitch)
    values = own.designed
    shared = {name: place for place, name in enumerate(model.names)}
    for place, name in enumerate(own.names):
        if name in (*model.of_lens, *SENSOR_POSE, BLUR):
            values[place] = numbers[shared[name]]
        if name in CHART_POSE:
            values[place] = _pose(field)[CHART_POSE.index(name)]
    landed = own.landed(values)
    points, light = own.on_sensor(values, landed, 0).points[0], landed[4, 0]
    spread = torch.randn(points.shape, generator=generator_of(0), dtype=points.dtype)
    blur = values[own.names.index(BLUR)].clamp(min=0.0)
    light = light / light.sum()
    centre = (light[:, None] * points).sum(0)
    places = (points - centre + blur.sqrt() * spread) / model.pitch + settings.size // 2
    return bin_rays(places[:, 1], places[:, 0], light, settings.size, settings.size, _SUBPIXELS)


def _by_photons(
    model: ChartModel,
    settings: Restoration,
    camera: TrueCamera,
    wavelengths: Sequence[float],
    field: Sequence[float],
    generator: torch.Generator,
) -> Tensor:
    """Return a function (K, K) photon by photon, about its centroid."""
    pitch, focal = model.pitch, _focal(model)
    chart = _far_point(pitch, focal)
    there = replace(camera, chart=_pose(field), planes=(settings.plane,), larger=0.0)
    # A few photons tell where it is.
    angle = torch.tensor([math.tan(math.radians(a)) for a in field], dtype=torch.float64)
    corner, side = focal * angle - _SEEN, int(2.0 * _SEEN / pitch)
    light = ChartLight(_FEW, 0.0, 0.0, tuple(wavelengths))
    seen = photographed(chart, there, light, corner[None, None], side, pitch, generator)
    share = seen.counts[0, 0] / seen.counts.sum()
    centre = torch.stack([(share.sum(0) * seen.x[0, 0]).sum(), (share.sum(1) * seen.y[0, 0]).sum()])
    light = replace(light, photons=settings.photons)
    corner = (centre - (settings.size // 2) * pitch)[None, None]
    counts = photographed(chart, there, light, corner, settings.size, pitch, generator).counts
    return counts[0, 0] / counts.sum()
