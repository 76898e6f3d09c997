"""Field curves show where thin pencils of light focus over the field, and how the image is
distorted.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan
from dolens.analysis.parabasal import ParabasalRays, parabasal_rays
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence


@dataclass(frozen=True)
class FieldCurves:
    """Field curvature and distortion along a scan of F fields at W wavelengths.

    Values are NaN where a chief ray does not reach the sensor.

    Attributes:
        scan: the fields.
        wavelengths: (W,), nm.
        reference_wavelength: nm, of the distortion.
        tangential: (F, W), mm: z of the tangential focus from the sensor where the chief ray meets
            it, plane or curved, positive behind it; infinite where the light is parallel.
        sagittal: (F, W), mm: the same of the sagittal focus.
        distortion: (F,), percent of the ideal image height, positive where the image lies farther
            out (pincushion); zero on the axis.
    """

    scan: FieldScan
    wavelengths: Tensor
    reference_wavelength: float
    tangential: Tensor
    sagittal: Tensor
    distortion: Tensor


def field_curves(
    lens: Lens,
    scan: FieldScan,
    wavelengths: list[float] | Tensor,
    object_distance: float | None = None,
) -> FieldCurves:
    """Compute field curvature and distortion from rays infinitely close to the chief rays.

    The tangential focus is where rays displaced along the scan come nearest to the chief ray (they
    meet it, in a centred lens), the sagittal one where rays displaced across it do.

    Distortion compares the chief ray's image point with that of an ideal lens, whose image is
    linear in the tangents of the field angles (f·tan θ), or in the object's heights.  The linear
    image is the limit of the real one near the axis, on the sensor where it stands.

    Args:
        lens: the lens; apertures clip no chief ray.
        scan: fields on a line through the axis (see `field_scans`).
        wavelengths: (W,), nm, of the field curvature.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    pencils = parabasal_rays(lens, scan.fields, waves, object_distance)
    along = scan.direction
    across = torch.stack((along[1], -along[0]))
    chief = image_displacement(lens, scan, [lens.primary_wavelength], object_distance)
    return FieldCurves(
        scan,
        waves,
        lens.primary_wavelength,
        focus(pencils, along),
        focus(pencils, across),
        chief.distortion[:, 0],
    )


def focus(pencils: ParabasalRays, displacement: Tensor) -> Tensor:
    """Return z (mm) from the sensor, (F, W), where rays displaced along a unit vector (2,) before
    the lens come nearest to the chief ray.

    The distance from it at z is |P + z·S| with P and S the displacement's image and slope, which
    is least at z = -P·S/S².
    """
    position = pencils.position_rate @ displacement
    slope = pencils.slope_rate @ displacement
    square = slope.square().sum(-1)
    # Parallel light has its focus at infinity.
    return torch.where(square == 0.0, torch.inf, -(position * slope).sum(-1) / square)


@dataclass(frozen=True)
class ImageDisplacement:
    """Chief rays of F fields and W wavelengths beside an ideal image.

    Attributes:
        outward: (F, W), mm: the image point's distance from the axial one of the reference
            wavelength, in the direction of the scan's image.
        ideal: (F,), mm, of the ideal lens at the reference wavelength.
        distortion: (F, W), percent: 100·(outward - ideal)/ideal, zero on the axis.
    """

    outward: Tensor
    ideal: Tensor
    distortion: Tensor


def image_displacement(
    lens: Lens,
    scan: FieldScan,
    wavelengths: list[float] | Tensor,
    object_distance: float | None = None,
) -> ImageDisplacement:
    """Compare chief rays with the image of an ideal lens; arguments are those of `field_curves`."""
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    axis = parabasal_rays(lens, [(0.0, 0.0)], [lens.primary_wavelength], object_distance)
    chief = parabasal_rays(lens, scan.fields, waves, object_distance).position
    image = axis.image_rate[0, 0] @ scan.direction
    rate = image.norm()
    outward = ((chief - axis.position[0]) * (image / rate)).sum(-1)
    linear = scan.coordinate
    if vergence(object_distance) == 0.0:
        linear = torch.deg2rad(linear).tan()
        # The line of field angles is one of tangents too only along x or y.
        tangents = torch.deg2rad(scan.fields).tan()
        linear = tangents.norm(dim=-1).copysign(linear)
    ideal = rate * linear
    distortion = 100.0 * (outward / ideal[:, None] - 1.0)
    return ImageDisplacement(outward, ideal, distortion.where(ideal[:, None] != 0.0, 0.0))
