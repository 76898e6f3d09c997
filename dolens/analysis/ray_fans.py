"""Ray fans show transverse ray aberrations along two diameters of the stop."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.ray_intercepts import trace_ray_intercepts
from dolens.errors import InputError
from dolens.optics.lens import Lens

# A ray that crosses the very rim is outside the stop's aperture.
_RIM = 1.0 - 1e-9


@dataclass(frozen=True)
class RayFans:
    """A `RayFans` holds transverse ray aberrations of F fields and W wavelengths at P points of the
    stop.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelengths: (W,), nm.
        reference_wavelength: nm, of the chief rays.
        coordinate: (P,), from -1 to 1, over the stop's semi-diameter.
        tangential_um: (F, W, P), µm: y on the sensor, less the chief ray's of the reference
            wavelength, of rays through (0, coordinate); NaN where a ray does not pass.
        sagittal_um: (F, W, P), µm: the same in x, of rays through (coordinate, 0).
    """

    fields: Tensor
    field_unit: str
    wavelengths: Tensor
    reference_wavelength: float
    coordinate: Tensor
    tangential_um: Tensor
    sagittal_um: Tensor


@torch.no_grad()
def ray_fans(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    count: int = 41,
    object_distance: float | None = None,
) -> RayFans:
    """Trace fans along y and x of the stop: tangential and sagittal for fields in the y-z plane.

    Every ray is aimed at its own wavelength.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        wavelengths: (W,), nm.
        count: points along each diameter; an odd number holds the centre.
        object_distance: mm in front of the first vertex; None for an object at infinity.

    Raises:
        InputError: no fields or wavelengths, or fewer than two points.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 points along a diameter, not {count}")
    coordinate = torch.linspace(-1.0, 1.0, count, dtype=torch.float64)
    along, across = _RIM * coordinate, torch.zeros_like(coordinate)
    pupil = torch.cat([torch.stack((across, along), -1), torch.stack((along, across), -1)])
    intercepts = trace_ray_intercepts(lens, fields, wavelengths, pupil, object_distance, exact=True)
    deviation = 1e3 * (intercepts.points - intercepts.chief[:, None, None])
    return RayFans(
        fields=intercepts.fields,
        field_unit=intercepts.field_unit,
        wavelengths=intercepts.wavelengths,
        reference_wavelength=lens.primary_wavelength,
        coordinate=coordinate,
        tangential_um=deviation[..., :count, 1],
        sagittal_um=deviation[..., count:, 0],
    )
