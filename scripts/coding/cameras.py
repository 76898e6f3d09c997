"""Cameras for an extended depth of field, and what linear filters make of them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from torch import Tensor
from torch.nn import functional

from dolens.diffraction.pixel_psf import with_diffraction_limit
from dolens.experiments.camera.views.whole import axial_function
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription
from dolens.reconstruction.wiener import linear_error_of_readouts, natural_spectrum
from dolens.rendering.exit_pupil import axial_f_number
from dolens.rendering.psf import axial_point_spread_functions
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

_LENS = Path(__file__).parents[2] / "conf/lens/wavefront_coding.yaml"
_LINES = (656.2725, 587.5618, 486.1327)
_SIZE, _SIDE, _SAMPLES = 97, 192, 32
# Photographs in linear light: mean, variance, and the scale (pixels) where 1/f² flattens.
_MEAN, _VARIANCE, _OUTER_SCALE = 0.2, 0.04, 64.0
FULL = 6.35  # semi-diameter of the stop, mm: F/8.03
F_NUMBERS = (8.0, 9.5, 11.0, 13.5, 16.0, 19.0, 22.0)
_CUBES = (0.5e-5, 1e-5, 1.5e-5, 2e-5, 3e-5, 4e-5, 6e-5, 8e-5, 12e-5, 16e-5)  # x3 = y3, mm⁻²
_QUARTICS = (-3e-6, -2e-6, -1e-6, -0.5e-6, 0.5e-6, 1e-6, 2e-6, 3e-6)  # x4 = y4 = x2y2 / 2, mm⁻³
_FOCI = 25
_SWEEP = 7  # foci of a sweep


@dataclass(frozen=True)
class Range:
    """A range of depths on a sensor.

    Attributes:
        depths: mm.
        pitch: of the pixels, mm.
    """

    depths: tuple[float, ...]
    pitch: float = 0.0069


class Shot(NamedTuple):
    """What is photographed, and in how much light.

    Attributes:
        scene: depths and pixels.
        light: electrons in white at F/8, of all readouts together.
        read_noise: electrons, of each readout.
    """

    scene: Range
    light: float
    read_noise: float = 3.0  # as conf/readout/electrons.yaml has it


@dataclass(frozen=True)
class DepthCamera:
    """The achromatic doublet as a camera of one exposure time.

    Attributes:
        family: what it is called.
        f_number: of the stop.
        foci: distances of the sensor, mm.
        plate: coefficients of the plate behind the lens.
        one: whether one readout has the light of all foci; else each has its own.
    """

    family: str
    f_number: float
    foci: tuple[float, ...]
    plate: Mapping[str, float] = field(default_factory=dict)
    one: bool = False

    def described(self) -> str:
        """Return the settings in words."""
        foci = ", ".join(f"{z:.2f}" for z in self.foci)
        plate = "".join(f", {name} = {value:.1e}" for name, value in self.plate.items())
        return f"F/{self.f_number:g}, {foci} mm{plate}"


class Bound(NamedTuple):
    """Mean squared errors at the worst depth: with one linear filter for all depths, and with one
    for each.
    """

    common: float
    each: float


@cache
def _lens(f_number: float, plate: tuple[tuple[str, float], ...]) -> Lens:
    prescription: dict[str, Any] = yaml.safe_load(_LENS.read_text(encoding="utf-8"))
    prescription["surfaces"]["1"]["semi_diameter"] = FULL * 8.0 / f_number
    prescription["surfaces"]["5"] |= dict(plate)
    return lens_from_prescription(prescription, torch.float32, where=str(_LENS), backend="auto")


def _lens_of(camera: DepthCamera) -> Lens:
    return _lens(camera.f_number, tuple(camera.plate.items()))


def foci_of(scene: Range) -> list[float]:
    """Return distances of the sensor about the images of the depths, mm."""
    efl = float(_lens(8.0, ()).first_order().efl.detach())
    at_focus = 95.86 - _image_distance(6000.0, efl)
    ends = [at_focus + _image_distance(z, efl) for z in scene.depths]
    low, high = min(ends), max(ends)
    spread = max(high - low, 0.5)
    step = 1.4 * spread / (_FOCI - 1)
    return [low - 0.2 * spread + k * step for k in range(_FOCI)]


def _image_distance(depth: float, efl: float) -> float:
    """Return the distance of the image of an object, thin lens, mm."""
    return 1.0 / (1.0 / efl - 1.0 / depth)


@cache
def _geometric(
    f_number: float, plate: tuple[tuple[str, float], ...], focus: float, scene: Range
) -> Tensor:
    """Functions (D, K, K) of rays in the middle colour with a perfect pupil's diffraction."""
    lens = _lens(f_number, plate)
    planes = PlanarScene(scene.depths, _LINES[1:2])
    values = {"sensor_distance": torch.tensor(focus)}
    sensor = Sensor(128, 128, scene.pitch)
    found = axial_point_spread_functions(lens.with_values(values), planes, sensor, _SIZE, _SAMPLES)
    n = axial_f_number(lens)
    return with_diffraction_limit(found, scene.pitch, planes.wavelengths, n)[:, 0]


def noise_of(camera: DepthCamera, shot: Shot) -> tuple[float, float]:
    """Return the noise of a readout: a·x + b at light x."""
    electrons = shot.light * (8.0 / camera.f_number) ** 2
    if not camera.one:
        electrons /= len(camera.foci)
    return 1.0 / electrons, (shot.read_noise / electrons) ** 2


@torch.no_grad()
def bound_of(camera: DepthCamera, shot: Shot) -> Bound:
    """Return the least errors of linear filters."""
    plate = tuple(camera.plate.items())
    each = torch.stack([_geometric(camera.f_number, plate, z, shot.scene) for z in camera.foci])
    photons, read = noise_of(camera, shot)
    variance, count = _MEAN * photons + read, len(each)
    if camera.one:
        each, count = each.mean(0, keepdim=True), 1
    spectrum = natural_spectrum(_SIDE, _SIDE, _VARIANCE, _OUTER_SCALE, torch.zeros(()))
    found = linear_error_of_readouts(each / math.sqrt(count), spectrum, variance / count)
    return Bound(float(found.common_filter.max()), float(found.filter_per_depth.max()))


def candidates(family: str, scene: Range) -> Iterator[DepthCamera]:
    """Yield the cameras of a family, `plain F/11`, `cubic`, `fixed cubic`, `quartic`, `sweep`,
    or `bracket of 3`.
    """
    foci = foci_of(scene)
    if family.startswith("plain"):
        yield from (DepthCamera(family, float(family.split("/")[1]), (z,)) for z in foci)
    elif family in ("cubic", "fixed cubic"):
        for cube in (1.5e-5,) if family.startswith("fixed") else _CUBES:
            plate = {"x3": cube, "y3": cube}
            yield from (DepthCamera(family, 8.0, (z,), plate) for z in foci)
    elif family == "quartic":
        for fourth in _QUARTICS:
            plate = {"x4": fourth, "x2y2": 2.0 * fourth, "y4": fourth}
            yield from (DepthCamera(family, 8.0, (z,), plate) for z in foci)
    else:
        count = _SWEEP if family == "sweep" else int(family.rsplit(" ", 1)[1])
        stops = (8.0,) if family == "sweep" else (8.0, 11.0)
        for stop in stops:
            for first in range(_FOCI):
                for step in range(1, (_FOCI - 1 - first) // (count - 1) + 1):
                    chosen = tuple(foci[first + k * step] for k in range(count))
                    yield DepthCamera(family, stop, chosen, {}, family == "sweep")


def best_of(family: str, shot: Shot, known: bool) -> tuple[DepthCamera, Bound]:
    """Return the camera of a family with the least error, of filters for each depth or for all."""
    found = [(c, bound_of(c, shot)) for c in candidates(family, shot.scene)]
    return min(found, key=lambda pair: pair[1].each if known else pair[1].common)


def refined(camera: DepthCamera, shot: Shot, known: bool) -> tuple[DepthCamera, Bound]:
    """Return a camera whose foci are free, by steps of coordinates that halve, and its errors."""

    def error(foci: Sequence[float]) -> float:
        found = bound_of(replace(camera, foci=tuple(foci)), shot)
        return found.each if known else found.common

    foci, step = list(camera.foci), 0.08
    least = error(foci)
    while step > 0.015:
        before = least
        for n in range(len(foci)):
            for move in (step, -step):
                trial = [z + move * (k == n) for k, z in enumerate(foci)]
                now = error(trial)
                if now < least:
                    foci, least = trial, now
        step = step if least < before else step / 2.0
    found = replace(camera, family=f"learned {camera.family}", foci=tuple(foci))
    return found, bound_of(found, shot)


def refocused(camera: DepthCamera, scene: Range) -> list[DepthCamera]:
    """Return a camera, and those whose foci are all a step nearer or farther."""
    foci = foci_of(scene)
    step = foci[1] - foci[0]
    return [
        replace(camera, foci=tuple(z + k * step for z in camera.foci)) for k in (0.0, -1.0, 1.0)
    ]


@torch.no_grad()
def wave_functions(camera: DepthCamera, scene: Range) -> Tensor:
    """Return point spread functions by wave optics, (readouts, D, 3, K, K), of unit sum."""
    lens, sensor = _lens_of(camera), Sensor(128, 128, scene.pitch)
    found = []
    for focus in camera.foci:
        values = {"sensor_distance": torch.tensor(focus)}
        found += [
            axial_function(lens.with_values(values), PlanarScene((z,), _LINES), sensor, 65, "wave")
            for z in scene.depths
        ]
    size = max(one.shape[-1] for one in found)
    each = torch.stack([functional.pad(f, ((size - f.shape[-1]) // 2,) * 4) for f in found])
    each = (each / each.sum((-2, -1), keepdim=True)).unflatten(0, (len(camera.foci), -1))
    return each.mean(0, keepdim=True) if camera.one else each
