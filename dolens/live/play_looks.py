"""What a page draws of a lens, as values that JSON has: section, spots, ray fans, MTF, numbers."""

import math
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.live.play import Seen
from dolens.optics.fields import field_label
from dolens.plotting.section import drawn_surfaces, glass_sections, sensor_curve, stop_bars
from dolens.plotting.style import number_text, ordered_colours, spectral_colour

# Of a section: rays of a field, and how far in front of the lens they begin, over its length with
# the sensor.
_RAYS, _LEAD = 7, 0.1
# Of a spot at a wavelength, and of all together, rays that are drawn.
_DOTS, _ALL_DOTS = 250, 3000


def conditions_of(seen: Seen) -> dict[str, Any]:
    """Return labels and colours of fields and wavelengths."""
    where = seen.draft.where
    return {
        "fields": [field_label(_short(point), where.field_unit) for point in where.fields],
        "colours": _colours(len(where.fields)),
        "wavelengths": [f"{float(wave):.4g} nm" for wave in where.wavelengths],
        "shades": [spectral_colour(float(wave)) for wave in where.wavelengths],
    }


@cache
def _colours(count: int) -> list[str]:
    return ordered_colours(count)


def _short(point: Tensor) -> tuple[float, float]:
    x, y = (float(f"{float(v):.4g}") for v in point)
    return x, y


@torch.no_grad()
def numbers_of(seen: Seen) -> list[list[str]]:
    """Return first-order numbers: names and values, as text."""
    draft = seen.draft
    where, lens = draft.where, draft.lens
    first = draft.first
    track = sum(abs(float(gap)) for gap in lens.thicknesses.values())
    track += abs(float(lens.sensor_distance))
    working = abs(float(first.working_f_number))
    return [
        ["EFL", _number(float(first.efl), "mm")],
        ["back focus", _number(float(first.bfd), "mm")],
        ["F-number" if where.object_distance is None else "working F-number", _number(working)],
        ["entrance pupil", _number(float(first.entrance_pupil.diameter), "mm")],
        ["track", _number(track, "mm")],
        ["Airy radius", _number(1e3 * draft.airy_radius or math.inf, "µm")],
        [
            "focus is off by",
            _number(draft.focus_shift, "mm")
            if abs(draft.focus_shift) >= 1.0
            else _number(round(1e3 * draft.focus_shift, 3), "µm"),
        ],
    ]


def _number(value: float, unit: str = "") -> str:
    return f"{number_text(value, 4)} {unit}".strip() if abs(value) < 1e9 else "–"


@torch.no_grad()
def section_of(seen: Seen) -> dict[str, Any]:
    """Return the section in the y-z plane: lists of z and y, mm."""
    draft, profiles = seen.draft, seen.profiles
    system = draft.lens.system()
    drawn = [np.stack(profile, -1) for profile in profiles if len(profile[0])]
    every = np.concatenate(drawn)
    height = float(np.abs(every[:, 1]).max())
    half = 0.5 * draft.lens.sensor_diameter if draft.lens.sensor_diameter else height
    sensor = sensor_curve(system, half)
    first, last = float(every[:, 0].min()), float(max(every[:, 0].max(), sensor[:, 0].max()))
    rays = draft.section_rays(first - _LEAD * (last - first), _RAYS)
    y = profiles[system.stop - 1][1]
    bars = stop_bars(system, profiles[system.stop - 1], 0.25 * float(np.abs(y).max(initial=0.0)))
    return {
        "glasses": [_points(glass.outline) for glass in glass_sections(system, profiles)],
        "surfaces": [
            {
                "number": number,
                "mirror": number in system.mirrors,
                "points": _points(np.stack(profiles[number - 1], -1)),
            }
            for number in drawn_surfaces(system, profiles)
        ],
        "stop": [_points(bar) for bar in bars],
        "sensor": _points(sensor),
        "rays": [[_points(path) for path in paths] for paths in rays],
    }


def _points(points: np.ndarray) -> list[list[float]]:
    """Return points (..., 2) as lists, rounded to what can be seen."""
    return _rounded(points, 1e-5 * float(np.abs(points).max(initial=1e-9)))


def _rounded(values: np.ndarray, step: float) -> list[Any]:
    """Return numbers as lists, rounded to a power of ten below a step: few digits to send."""
    decimals = -math.floor(math.log10(max(step, 1e-12)))
    return np.round(values, decimals).tolist()


def spots_of(seen: Seen) -> dict[str, Any]:
    """Return points of each field and wavelength, µm from the field's centroid, and RMS radii, µm;
    None of dark fields.
    """
    points, rms = seen.draft.spots
    generator = torch.Generator().manual_seed(0)  # the same at each change, and no rows of a grid
    some = torch.randperm(points.shape[2], generator=generator)
    points = 1e3 * points[:, :, some]
    passing = points[..., 0].isfinite()
    dots = min(_DOTS, _ALL_DOTS // (points.shape[0] * points.shape[1]))
    step = 5e-4 * float(points[passing].abs().amax()) if bool(passing.any()) else 1.0
    found = [
        [_rounded(cloud[ok][:dots].numpy(), step) for cloud, ok in zip(field, light, strict=True)]
        for field, light in zip(points, passing, strict=True)
    ]
    return {"points": found, "rms": _or_none(1e3 * rms), "airy": 1e3 * seen.draft.airy_radius}


def fans_of(seen: Seen) -> list[Any]:
    """Return transverse aberrations, µm, as (F, W, 2, P) of lists."""
    return _or_none(seen.draft.ray_fans())


def modulation_of(seen: Seen) -> dict[str, Any]:
    """Return frequencies, cycles/mm, and contrast as (F, 2, Q) of lists."""
    frequencies, curves = seen.draft.modulation()
    return {"frequencies": frequencies.tolist(), "curves": _or_none(curves)}


def blur_of(seen: Seen) -> float:
    """Return how far from their centroid rays land, mm."""
    return float(seen.draft.spots[0].nan_to_num(0.0).norm(dim=-1).max())


def _or_none(values: Tensor) -> list[Any]:
    """Return a tensor as lists of four digits, None where it has no number."""
    if values.ndim > 1:
        return [_or_none(part) for part in values]
    return [float(f"{v:.4g}") if math.isfinite(v) else None for v in values.tolist()]
