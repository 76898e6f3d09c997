"""Relative illumination along the field, from the solid angle in which the image sees the pupil."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan, conditions
from dolens.diffraction.field_wavefronts import field_wavefronts
from dolens.optics.lens import Lens


@dataclass(frozen=True)
class Illumination:
    """Relative illumination along a scan of F fields.

    Attributes:
        scan: the fields.
        wavelength: nm.
        relative: (F,), irradiance of the image of a uniform Lambertian object plane over that on
            the axis; zero where no light passes, NaN where none passes on the axis.
        cosine_fourth: (F,), cos⁴ of the angle between chief ray and axis before the lens, for
            comparison.
        image_height: (F,), mm, distance of the light's centroid on the sensor from the axial one;
            NaN where no light passes.
    """

    scan: FieldScan
    wavelength: float
    relative: Tensor
    cosine_fourth: Tensor
    image_height: Tensor


@torch.no_grad()
def relative_illumination(
    lens: Lens, scan: FieldScan, wavelength: float | None = None, samples: int = 48
) -> Illumination:
    """Compute the relative illumination of a lens, vignetting included.

    The irradiance at an image point is the radiance times the area of the exit pupil in direction
    cosines as the point sees it, ∬dα dβ (Rimmer, Proc. SPIE 655, 99, 1986): the rays of an object
    point are taken to meet in one image point.  Of a lens with coatings each direction counts by
    what of its light arrives.

    Args:
        lens: the lens.
        scan: fields on a line through the axis (see `field_scans`).
        wavelength: nm; None for the lens's reference wavelength.
        samples: rays along each side of a box about each beam.
    """
    wavelength = wavelength or lens.primary_wavelength
    fields = torch.cat([torch.zeros(1, 2, dtype=torch.float64), scan.fields])
    distance = scan.object_distance
    found = field_wavefronts(
        lens, conditions(lens, fields, wavelength, distance or torch.inf), samples
    )
    front = found.wavefront
    passed = 1.0 if front.passed is None else front.passed
    area = (front.area * front.coverage * passed).sum((-2, -1)).cpu()
    height = (found.centre - found.centre[0]).norm(dim=-1)
    slopes = torch.deg2rad(scan.fields).tan()
    if distance is not None:
        slopes = scan.fields / distance
    return Illumination(
        scan,
        float(wavelength),
        area[1:] / area[0].where(area[0] > 0.0, torch.nan),
        (1.0 + slopes.square().sum(-1)) ** -2,
        height[1:].where(found.lit[1:, 0], torch.nan),
    )
