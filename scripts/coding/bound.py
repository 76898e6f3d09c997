"""The gain of a phase plate by the best linear filters: no training, no photographs, seconds."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import yaml
from torch import Tensor

from dolens.diffraction.diffraction_limit import with_diffraction_limit
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription
from dolens.reconstruction.linear_bound import linear_error, natural_spectrum
from dolens.rendering.psf import axial_point_spread_functions
from dolens.rendering.pupil.f_number import axial_f_number
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

_LENS = Path(__file__).parents[2] / "conf/lens/wavefront_coding.yaml"
_SENSOR = Sensor(128, 128, 0.0069)
_WAVELENGTH = 587.5618
_SIZE, _SIDE, _SAMPLES = 97, 128, 32
# Photographs in linear light: mean, variance, and the scale (pixels) where 1/f² flattens.
_MEAN, _VARIANCE, _OUTER_SCALE = 0.2, 0.04, 64.0
_FULL = 6.35
_LOSSES = [2.0 ** (k / 2.0) for k in range(9)]  # of light, from full aperture to four stops
_PLATES = [0.5e-5, 1e-5, 1.5e-5, 2e-5, 3e-5, 4e-5, 6e-5, 8e-5]  # x3 = y3
_FOCUS, _FOCUS_SHIFTS = 95.86, [k / 6.0 for k in range(-3, 4)]  # mm


@dataclass(frozen=True)
class BoundGain:
    """Gains in dB at the worst depth, each side with its own best settings.

    Attributes:
        light: electrons of a white pixel at full aperture.
        common_filter: with one filter for all depths.
        filter_per_depth: with a filter for each depth.
        plain_f_number: of the best plain lens with one filter.
        plate: x3 = y3 (mm⁻²) of the best plate with one filter.
    """

    light: float
    common_filter: float
    filter_per_depth: float
    plain_f_number: float
    plate: float


@dataclass(frozen=True)
class _Candidate:
    functions: Tensor  # (D, K, K)
    f_number: float
    plate: float


@torch.no_grad()
def bound_gains(
    depths: Sequence[float],
    lights: Sequence[float],
    read_noise: float,
    shifts: Sequence[float] = _FOCUS_SHIFTS,
) -> list[BoundGain]:
    """Gains over the best plain lens, F-number and focus searched, at several light levels.

    Geometric functions on the axis with a perfect pupil's diffraction; the noise is that of a mean
    grey: variance (mean·n + r²)/n² for n electrons in white and read noise r.

    Args:
        depths: of the scene, mm.
        lights: electrons of a white pixel at full aperture.
        read_noise: electrons.
        shifts: of the sensor that are tried, mm.
    """
    spectrum = natural_spectrum(_SIDE, _SIDE, _VARIANCE, _OUTER_SCALE, torch.zeros(()))
    plain, coded = list(_plain(depths, shifts)), list(_coded(depths, shifts))
    full = coded[0].f_number
    found = []
    for light in lights:
        sides = []
        for candidates in (plain, coded):
            errors = []
            for candidate in candidates:
                electrons = light * (full / candidate.f_number) ** 2
                noise = _MEAN / electrons + (read_noise / electrons) ** 2
                error = linear_error(candidate.functions, spectrum, noise)
                errors.append(
                    (
                        float(error.common_filter.max()),
                        float(error.filter_per_depth.max()),
                        candidate,
                    )
                )
            sides.append((min(errors, key=lambda e: e[0]), min(errors, key=lambda e: e[1])))
        (plain_shared, plain_own), (coded_shared, coded_own) = sides
        found.append(
            BoundGain(
                light,
                10.0 * math.log10(plain_shared[0] / coded_shared[0]),
                10.0 * math.log10(plain_own[1] / coded_own[1]),
                plain_shared[2].f_number,
                coded_shared[2].plate,
            )
        )
    return found


def _plain(depths: Sequence[float], shifts: Sequence[float]) -> Iterator[_Candidate]:
    for loss in _LOSSES:
        lens = _lens(_FULL / math.sqrt(loss))
        f_number = axial_f_number(lens)
        for shift in shifts:
            yield _candidate(lens, f_number, depths, _FOCUS + shift, 0.0)


def _coded(depths: Sequence[float], shifts: Sequence[float]) -> Iterator[_Candidate]:
    lens = _lens(_FULL)
    f_number = axial_f_number(lens)
    for plate in _PLATES:
        for shift in shifts:
            yield _candidate(lens, f_number, depths, _FOCUS + shift, plate)


def _lens(semi_diameter: float) -> Lens:
    prescription = yaml.safe_load(_LENS.read_text(encoding="utf-8"))
    prescription["surfaces"]["1"]["semi_diameter"] = semi_diameter
    return lens_from_prescription(prescription, torch.float32, where=str(_LENS), backend="auto")


def _candidate(
    lens: Lens, f_number: float, depths: Sequence[float], focus: float, plate: float
) -> _Candidate:
    scene, pitch = PlanarScene(tuple(depths), (_WAVELENGTH,)), _SENSOR.pixel_pitch
    values = {"sensor_distance": torch.tensor(focus)}
    values |= {f"surfaces.5.{name}": torch.tensor(plate) for name in ("x3", "y3")}
    functions = axial_point_spread_functions(lens, scene, _SENSOR, _SIZE, _SAMPLES, values)
    functions = with_diffraction_limit(functions, pitch, scene.wavelengths, f_number)
    return _Candidate(functions[:, 0], f_number, plate)
