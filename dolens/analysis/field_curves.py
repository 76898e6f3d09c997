"""Field curves show where thin pencils of light focus over the field, and how the image is
distorted.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan
from dolens.analysis.parabasal import ParabasalRays, parabasal_rays
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence

# Ideal image heights of an object at infinity, and as figures write them.
DISTORTION_REFERENCES = {"f_tan_theta": "f·tan θ", "f_theta": "f·θ"}


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
        distortion_reference: `f_tan_theta` or `f_theta`: the ideal image height; see
            `image_displacement`.
    """

    scan: FieldScan
    wavelengths: Tensor
    reference_wavelength: float
    tangential: Tensor
    sagittal: Tensor
    distortion: Tensor
    distortion_reference: str = "f_tan_theta"


def field_curves(
    lens: Lens,
    scan: FieldScan,
    wavelengths: list[float] | Tensor,
    object_distance: float | None = None,
    distortion_reference: str = "f_tan_theta",
) -> FieldCurves:
    """Compute field curvature and distortion from rays infinitely close to the chief rays.

    The tangential focus is where rays displaced along the scan come nearest to the chief ray (they
    meet it, in a centred lens), the sagittal one where rays displaced across it do.

    Distortion compares the chief ray's image point with that of an ideal lens; see
    `image_displacement`.

    Args:
        lens: the lens; apertures clip no chief ray.
        scan: fields on a line through the axis (see `field_scans`).
        wavelengths: (W,), nm, of the field curvature.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        distortion_reference: `f_tan_theta`, or `f_theta` for an object at infinity.

    Raises:
        InputError: another reference, or `f_theta` of a near object.
    """
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    pencils = parabasal_rays(lens, scan.fields, waves, object_distance)
    along = scan.direction
    across = torch.stack((along[1], -along[0]))
    chief = image_displacement(
        lens, scan, [lens.primary_wavelength], object_distance, distortion_reference
    )
    return FieldCurves(
        scan,
        waves,
        lens.primary_wavelength,
        focus(pencils, along),
        focus(pencils, across),
        chief.distortion[:, 0],
        distortion_reference,
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
    reference: str = "f_tan_theta",
) -> ImageDisplacement:
    """Compare chief rays with the image of an ideal lens; arguments are those of `field_curves`.

    The ideal image is linear in the object's heights; for an object at infinity in tan θ, as a lens
    images that keeps straight lines straight, or in θ itself, as scan lenses and fisheyes are meant
    to (Laikin, Lens Design).  θ is the angle between the field's light and the axis.  The linear
    image is the limit of the real one near the axis, on the sensor where it stands.

    Raises:
        InputError: another reference, or `f_theta` of a near object.
    """
    if reference not in DISTORTION_REFERENCES:
        known = ", ".join(DISTORTION_REFERENCES)
        raise InputError(f"a distortion's reference is one of {known}, not '{reference}'")
    infinite = vergence(object_distance) == 0.0
    if reference == "f_theta" and not infinite:
        raise InputError(
            "distortion from f·θ is that of an object at infinity; a near object has heights"
        )
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    axis = parabasal_rays(lens, [(0.0, 0.0)], [lens.primary_wavelength], object_distance)
    chief = parabasal_rays(lens, scan.fields, waves, object_distance).position
    image = axis.image_rate[0, 0] @ scan.direction
    rate = image.norm()
    outward = ((chief - axis.position[0]) * (image / rate)).sum(-1)
    linear = scan.coordinate
    if infinite:
        # The line of field angles is one of tangents too only along x or y.
        tangents = torch.deg2rad(scan.fields).tan().norm(dim=-1)
        linear = (tangents.atan() if reference == "f_theta" else tangents).copysign(linear)
    ideal = rate * linear
    distortion = 100.0 * (outward / ideal[:, None] - 1.0)
    return ImageDisplacement(outward, ideal, distortion.where(ideal[:, None] != 0.0, 0.0))
