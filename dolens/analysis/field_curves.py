"""Field curves show where thin pencils of light focus over the field, and how the image is
distorted; parabasal rays, infinitely close to a chief ray, give the foci.

Their intercepts and slopes are linear in where they enter the lens, with the derivatives of the
exact trace as coefficients.  They tell where a thin pencil about the chief ray has its two foci,
which Coddington's equations give for surfaces whose principal curvatures are known (Welford,
Aberrations of Optical Systems, section 9.2); these derivatives take any surface and any pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan
from dolens.errors import InputError, check_choice
from dolens.optics.aiming import field_line, launch
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Rays, arrives


@dataclass(frozen=True)
class ParabasalRays:
    """Chief rays of F fields and W wavelengths, and the pencils about them; float64 on the CPU.

    Numbers are NaN where the chief ray does not reach the sensor.

    Attributes:
        position: (F, W, 2), mm, of the chief rays on the sensor.
        slope: (F, W, 2), dx/dz and dy/dz behind the last surface.
        position_rate: (F, W, 2, 2), ∂position/∂q, with q (mm) across the beam in the plane
            through the first vertex that faces the field (see `dolens.optics.aiming`).  Of a
            curved sensor on the plane z = const. through the chief ray's point.
        slope_rate: (F, W, 2, 2), ∂slope/∂q, 1/mm.
        image_rate: (F, W, 2, 2), mm, ∂position/∂(tan x, tan y) for an object at infinity, else
            ∂position/∂(object height), without unit: how the chief ray moves with the field.
    """

    position: Tensor
    slope: Tensor
    position_rate: Tensor
    slope_rate: Tensor
    image_rate: Tensor


def parabasal_rays(
    lens: Lens, scan: FieldScan, wavelengths: Sequence[float] | Tensor
) -> ParabasalRays:
    """Trace the chief rays of a scan's fields, and the rays infinitely close to them.

    Apertures clip nothing here: a chief ray counts wherever it reaches the sensor.

    Args:
        lens: the lens.
        scan: F fields and the object distance.
        wavelengths: (W,), nm; each has its own chief ray.
    """
    lens = in_double_precision(lens)
    options: dict[str, Any] = {"dtype": torch.float64, "device": lens.device}
    field = scan.fields.to(**options)
    waves = torch.as_tensor(wavelengths, **options).reshape(-1)
    near = vergence(scan.object_distance)
    if near == 0.0:
        require_from_the_front(field, "a map of chief rays against the tangent of the field")
    with torch.enable_grad():
        # The coordinate in which an ideal lens's image is linear.
        linear = torch.deg2rad(field).tan() if near == 0.0 else field
        linear = linear[:, None].expand(-1, len(waves), 2).clone().requires_grad_()
        given = torch.rad2deg(linear.atan()) if near == 0.0 else linear
        aimed = lens.aim(given, (0.0, 0.0), waves, scan.object_distance)
        chief = lens.trace(aimed)
        reached = aimed.converged & arrives(chief.status)
        image_rate = _rates(chief.position[..., :2], linear)

        q = aimed.crossing.clone().requires_grad_()
        angles = torch.deg2rad(field) if near == 0.0 else field
        line, _ = field_line(angles, scan.object_distance)
        ray = launch(line[:, None], near, q)
        hit = lens.trace(Rays.from_components(ray, waves))
        reached = reached & arrives(hit.status)
        position = hit.position[..., :2]
        slope = hit.direction[..., :2] / hit.direction[..., 2:]
        if lens.sensor_curvature is not None:
            # On the plane through the chief ray's point, where the sag does not move.
            z = hit.position[..., 2:]
            position = position - slope * (z - z.detach())
        rates = _rates(position, q), _rates(slope, q)

    def found(values: Tensor) -> Tensor:
        there = reached.reshape(*reached.shape, *(1,) * (values.ndim - 2))
        return values.detach().where(there, torch.nan).cpu()

    return ParabasalRays(*map(found, (position, slope, *rates, image_rate)))


def _rates(values: Tensor, inputs: Tensor) -> Tensor:
    """Return ∂values/∂inputs (..., 2, 2) of values (..., 2), each of its own inputs (..., 2)."""
    rows = []
    for axis in range(2):
        (row,) = torch.autograd.grad(
            values[..., axis].sum(), inputs, retain_graph=True, allow_unused=True
        )
        rows.append(torch.zeros_like(inputs) if row is None else row)
    return torch.stack(rows, -2)


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
    wavelengths: Sequence[float] | Tensor,
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
        distortion_reference: `f_tan_theta`, or `f_theta` for an object at infinity.

    Raises:
        InputError: another reference, or `f_theta` of a near object.
    """
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    pencils = parabasal_rays(lens, scan, waves)
    along = scan.direction
    across = torch.stack((along[1], -along[0]))
    chief = image_displacement(lens, scan, [lens.primary_wavelength], distortion_reference)
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
    wavelengths: Sequence[float] | Tensor,
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
    check_choice(reference, DISTORTION_REFERENCES, "distortion")
    infinite = vergence(scan.object_distance) == 0.0
    if reference == "f_theta" and not infinite:
        raise InputError(
            "distortion from f·θ is that of an object at infinity; a near object has heights"
        )
    waves = torch.as_tensor(wavelengths, dtype=torch.float64).reshape(-1)
    on_axis = replace(scan, fields=torch.zeros(1, 2), coordinate=torch.zeros(1))
    axis = parabasal_rays(lens, on_axis, [lens.primary_wavelength])
    chief = parabasal_rays(lens, scan, waves).position
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
