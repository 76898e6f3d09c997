"""Wavefronts and pupils of a lens's fields and wavelengths, which several analyses share."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.fields_and_wavelengths import field_unit
from dolens.diffraction.entrance_beam import EntranceBeam, ObjectPoints, find_beam
from dolens.diffraction.field_pupil import FieldPupil
from dolens.diffraction.pupil_fit import dilated
from dolens.diffraction.wavefront import Wavefront, coverage, pupil_wavefront
from dolens.optics.lens import Lens
from dolens.optics.system import OpticalSystem, require_seen_by_rays

# Rays along each side of the beam that find where the light lands.
_COARSE = 16


@dataclass(frozen=True)
class FieldWavefronts(AtConditions):
    """Wavefronts of F fields and W wavelengths; no gradient.

    All wavelengths of a field have one reference point on the sensor, so that lateral colour shows
    as a tilt.

    Attributes:
        centre: (F, 2), mm on the sensor: the centroid of the polychromatic light.
        wavefront: F·W wavefronts to spheres about `centre`, wavelengths of a field together.
        lit: (F, W), bool: light passes.
    """

    centre: Tensor
    wavefront: Wavefront
    lit: Tensor


@torch.no_grad()
def field_wavefronts(lens: Lens, where: Conditions, samples: int = 32) -> FieldWavefronts:
    """Trace the wavefronts of every field and wavelength.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        samples: rays along each side of a box about each beam.

    Raises:
        InputError: a sphere that cannot be placed.
    """
    system = lens.system().double()
    require_seen_by_rays(system, "wavefronts")
    field, waves = where.fields.to(system.device), where.wavelengths.to(system.device)
    spectrum = where.weights.to(field)
    shape = (len(field), len(waves))
    every = field.repeat_interleave(len(waves), 0)
    points = object_points(every, where.object_distance)
    wave = waves.repeat(len(field))
    beam = find_beam(system, points, wave)
    coarse = _coarse(system, points, wave, beam)
    light = (coarse.amplitude * coarse.weight).unflatten(0, shape) * spectrum[:, None, None]
    total = light.sum((1, 2, 3))
    landed = coarse.landed.unflatten(0, shape)
    centre = (light[..., None] * landed).sum((1, 2, 3)) / total[:, None]
    centre = centre.where(total[:, None] > 0.0, 0.0)
    centres = centre.repeat_interleave(len(waves), 0)
    front = pupil_wavefront(system, points, wave, centres, samples, beam=beam)
    return FieldWavefronts(
        where,
        centre.cpu(),
        front,
        (front.flux > 0.0).unflatten(0, shape).cpu(),
    )


def light_centroids(
    system: OpticalSystem, points: ObjectPoints, wavelength: Tensor, beam: EntranceBeam
) -> Tensor:
    """Return the centroids (N, 2), mm on the sensor, of the light of N points; zero without any."""
    coarse = _coarse(system, points, wavelength, beam)
    light = coarse.amplitude * coarse.weight
    total = light.sum((1, 2))[:, None]
    centre = (light[..., None] * coarse.intercept).sum((1, 2)) / total
    return centre.where(total > 0.0, 0.0)


def _coarse(
    system: OpticalSystem, points: ObjectPoints, wavelength: Tensor, beam: EntranceBeam
) -> Wavefront:
    """Return wavefronts of few rays, about the sensor's origin."""
    middle = torch.zeros_like(points.slopes)
    # An infinite sphere is met by all rays, however far they land from its centre.
    return pupil_wavefront(system, points, wavelength, middle, _COARSE, math.inf, beam)


def object_points(fields: Tensor, object_distance: float | None) -> ObjectPoints:
    """Return the object points of fields (N, 2), degrees for an object at infinity, else mm."""
    if object_distance is None or field_unit(object_distance) == "°":
        return ObjectPoints.at_infinity(fields)
    away = torch.full_like(fields[:, :1], -float(object_distance))
    return ObjectPoints.at(torch.cat([fields, away], -1))


# Samples across the pupil beyond which rays alone make the image: a spot of some 70 Airy radii.
_MOST_SAMPLES = 512
_DRAFT_SAMPLES = 384


@dataclass(frozen=True)
class PreparedPupils:
    """The pupils of F fields, which several analyses may share.

    Attributes:
        wavefronts: of all fields and of the wavelengths that count.
        pupils: of every field; None for a field without light.
    """

    wavefronts: FieldWavefronts
    pupils: list[FieldPupil | None]


@torch.no_grad()
def prepare_pupils(
    lens: Lens, where: Conditions, most_samples: int = _MOST_SAMPLES, draft: bool = False
) -> PreparedPupils:
    """Trace the wavefronts of every field and fit its pupils; arguments as `point_spread`'s.

    Wavefronts that need more samples across the pupil than `most_samples` are left to rays; of a
    draft those that need more than 384 are, and no rays are traced for them.
    """
    found = field_wavefronts(lens, where.that_count())
    settings = (min(most_samples, _DRAFT_SAMPLES), 0) if draft else (most_samples,)
    return PreparedPupils(found, _field_pupils(lens, found, *settings))


def _field_pupils(lens: Lens, found: FieldWavefronts, *settings: int) -> list[FieldPupil | None]:
    """Return the pupils of every field, None for a field without light.

    Args:
        lens: the lens.
        found: its wavefronts.
        settings: the last arguments of `FieldPupil.of`.
    """
    system = lens.system().double()
    where = found.where
    count = len(where.wavelengths)
    weights = where.weights.to(system.device)
    pupils: list[FieldPupil | None] = []
    for number, lit in enumerate(found.lit.any(1).tolist()):
        if not lit:
            pupils.append(None)
            continue
        which = torch.arange(number * count, (number + 1) * count, device=system.device)
        field = where.fields[number].to(system.device).expand(count, 2)
        point = object_points(field, where.object_distance)
        front = part_of(found.wavefront, which)
        pupils.append(FieldPupil.of(system, point, front, weights, *settings))
    return pupils


def part_of(front: Wavefront, which: Tensor) -> Wavefront:
    """Return some of the wavefronts, with the apertures that clip these."""
    values: dict[str, Any] = {
        name: value[which] if isinstance(value, Tensor) else value
        for name, value in vars(front).items()
    }
    passing = dilated(values["coverage"] > 0.0, 2)
    kept = {}
    for number, crossing in front.crossings.items():
        x, y = crossing[which].unbind(-1)
        if bool((coverage(front.clipping[number].aperture, x, y)[passing] < 1.0).any()):
            kept[number] = crossing[which]
    values["crossings"] = kept
    values["clipping"] = {number: front.clipping[number] for number in kept}
    return Wavefront(**values)
