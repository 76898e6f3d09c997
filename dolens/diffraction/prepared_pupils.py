"""The pupils of a lens's fields, which several analyses share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.fields_and_wavelengths import that_count
from dolens.diffraction.field_pupil import FieldPupil
from dolens.diffraction.field_wavefronts import FieldWavefronts, field_wavefronts, object_points
from dolens.diffraction.pupil_edges import coverage
from dolens.diffraction.pupil_fit import dilated
from dolens.diffraction.wavefront import Wavefront
from dolens.optics.lens import Lens

# Samples across the pupil beyond which rays alone make the image: a spot of some 70 Airy radii.
_MOST_SAMPLES = 512


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
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    object_distance: float | None = None,
    wavelength_weights: Sequence[float] | None = None,
    most_samples: int = _MOST_SAMPLES,
) -> PreparedPupils:
    """Trace the wavefronts of every field and fit its pupils; arguments as `point_spread`'s.

    Wavefronts that need more samples across the pupil than `most_samples` are left to rays.
    """
    waves, shares = that_count(lens, wavelengths, wavelength_weights)
    found = field_wavefronts(lens, fields, waves, object_distance, shares)
    return PreparedPupils(found, _field_pupils(lens, found, object_distance, most_samples))


def _field_pupils(
    lens: Lens,
    found: FieldWavefronts,
    object_distance: float | None,
    most_samples: int = _MOST_SAMPLES,
) -> list[FieldPupil | None]:
    """Return the pupils of every field, None for a field without light.

    Wavefronts that need more samples across the pupil than `most_samples` are left to rays.
    """
    system = lens.system().double()
    count = len(found.wavelengths)
    weights = found.weights.to(system.device)
    pupils: list[FieldPupil | None] = []
    for number, lit in enumerate(found.lit.any(1).tolist()):
        if not lit:
            pupils.append(None)
            continue
        which = torch.arange(number * count, (number + 1) * count, device=system.device)
        field = found.fields[number].to(system.device).expand(count, 2)
        point = object_points(field, object_distance)
        front = part_of(found.wavefront, which)
        pupils.append(FieldPupil.of(system, point, front, weights, most_samples))
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
