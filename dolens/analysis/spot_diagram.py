"""Spot diagrams show the ray intercepts of an object point; RMS radii measure their spread, also
over the field and the wavelength.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.fields_and_wavelengths import spectral_shares
from dolens.analysis.ray_intercepts import trace_ray_intercepts, uniform_pupil_points
from dolens.errors import InputError
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order

# First zero of Bessel's J₁ over π; Airy's radius is 1.22·λ·N.
AIRY = 1.2196698912665045


@dataclass(frozen=True)
class SpotDiagram:
    """A `SpotDiagram` holds spots of F fields and W wavelengths by N points of the stop, in double
    precision on the CPU.

    Values of fields or wavelengths that no light reaches are NaN.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelengths: (W,), nm.
        reference_wavelength: nm, of the chief rays.
        intercepts: (F, W, N, 2), mm on the sensor; NaN for rays that do not pass.
        valid: (F, W, N), bool.
        weight: (N,), share of a ray in the light through the stop; zero for rays on its rim.
        wavelength_weight: (W,), shares of the wavelengths in polychromatic values.
        chief: (F, 2), mm, intercept of the chief ray of the reference wavelength.
        centroid: (F, W, 2), mm.
        rms: (F, W), mm, √(Σ w·|p - p̄|²) about the spot's own centroid.
        geo: (F, W), mm, the largest |p - p̄|; over the rim of the stop too, but no nearer to an edge
            that another aperture makes than the rays are apart.
        polychromatic_centroid: (F, 2), mm, of all wavelengths together.
        polychromatic_rms: (F,), mm, about that.
        airy_radius: (W,), mm, 1.22·λ·N with the paraxial working F-number of the stop.
    """

    fields: Tensor
    field_unit: str
    wavelengths: Tensor
    reference_wavelength: float
    intercepts: Tensor
    valid: Tensor
    weight: Tensor
    wavelength_weight: Tensor
    chief: Tensor
    centroid: Tensor
    rms: Tensor
    geo: Tensor
    polychromatic_centroid: Tensor
    polychromatic_rms: Tensor
    airy_radius: Tensor


@torch.no_grad()
def spot_diagram(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    rays: int = 2000,
    object_distance: float | None = None,
    wavelength_weights: Sequence[float] | Tensor | None = None,
) -> SpotDiagram:
    """Trace rays spread uniformly over the stop, at every field and wavelength.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        wavelengths: (W,), nm.
        rays: of each spot, a multiple of four, before apertures clip any.  RMS radii of two
            thousand err by some 1e-4 of themselves where only the stop clips, and by a few
            hundredths at the edge of a field that has lost most of its light.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        wavelength_weights: (W,), of any sum; None: see `spectral_shares`.

    Raises:
        InputError: no fields or wavelengths, weights that do not fit, or a wrong number of rays.
    """
    lens = in_double_precision(lens)
    pupil, weight = uniform_pupil_points(rays)
    intercepts = trace_ray_intercepts(lens, fields, wavelengths, pupil, object_distance)
    points, valid = intercepts.points, intercepts.valid
    waves = intercepts.wavelengths
    spectrum = spectral_shares(lens, waves, wavelength_weights)

    light = weight * valid
    centroid, mean_square = moments(points, light)
    extent = (points - centroid[:, :, None]).norm(dim=-1).nan_to_num(-math.inf).amax(-1)
    every = (light * spectrum[:, None]).flatten(1, 2)
    common, common_square = moments(points.flatten(1, 2), every)
    return SpotDiagram(
        fields=intercepts.fields,
        field_unit=intercepts.field_unit,
        wavelengths=waves,
        reference_wavelength=lens.primary_wavelength,
        intercepts=points,
        valid=valid,
        weight=weight,
        wavelength_weight=spectrum,
        chief=intercepts.chief,
        centroid=centroid,
        rms=mean_square.sqrt(),
        geo=extent.where(extent >= 0.0, math.nan),
        polychromatic_centroid=common,
        polychromatic_rms=common_square.sqrt(),
        airy_radius=AIRY * waves * 1e-6 * working_f_numbers(lens, waves, object_distance),
    )


def moments(points: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return the centroid (..., 2) of points (..., N, 2) and their mean square distance from it
    (...).

    Args:
        points: NaN where there is no light.
        light: (..., N), of any sum; both results are NaN where it is zero.
    """
    share = (light / light.sum(-1, keepdim=True))[..., None]
    there = light[..., None] > 0.0
    # Without light every share is 0/0, and so is the sum.
    dark = torch.where(torch.isnan(share), share, 0.0)
    centroid = torch.where(there, share * points, dark).sum(-2)
    square = share * (points - centroid[..., None, :]).square()
    return centroid, torch.where(there, square, dark).sum((-2, -1))


def working_f_numbers(lens: Lens, wavelengths: Tensor, object_distance: float | None) -> Tensor:
    """Return the paraxial working F-number at each wavelength in nm, (W,), positive."""
    system = lens.system()
    numbers = [
        first_order(system, float(wavelength), object_distance).working_f_number.abs()
        for wavelength in wavelengths
    ]
    return torch.stack(numbers).detach().double().cpu()


@dataclass(frozen=True)
class RMSCurves:
    """An `RMSCurves` holds RMS spot radii of F fields and W wavelengths; NaN where no light passes.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelengths: (W,), nm.
        rms: (F, W), mm, about each spot's own centroid.
        polychromatic: (F,), mm, of all wavelengths together about their common centroid.
        airy_radius: (W,), mm.
    """

    fields: Tensor
    field_unit: str
    wavelengths: Tensor
    rms: Tensor
    polychromatic: Tensor
    airy_radius: Tensor


def rms_against_field(
    lens: Lens,
    wavelengths: Sequence[float] | Tensor,
    field: Sequence[float] | Tensor | None = None,
    count: int = 15,
    rays: int = 4000,
    object_distance: float | None = None,
    wavelength_weights: Sequence[float] | None = None,
) -> RMSCurves:
    """Compute RMS spot radii at evenly spaced fields from the axis to an edge.

    Args:
        lens: the lens.
        wavelengths: (W,), nm.
        field: the edge, (x, y) in degrees or mm; None for the largest of the lens's own fields.
        count: fields, with the axis and the edge.
        rays: of each spot, a multiple of four, before apertures clip any.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        wavelength_weights: (W,), of the polychromatic spot, of any sum; None: see
            `spectral_shares`.

    Raises:
        InputError: no field is given and the lens has none of that kind, or fewer than two are
            asked for.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 fields, not {count}")
    edge = torch.tensor(_largest(lens, object_distance) if field is None else tuple(field))
    fields = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None] * edge.double()
    return _curves(lens, fields, wavelengths, rays, object_distance, wavelength_weights)


def rms_against_wavelength(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    interval: tuple[float, float] | None = None,
    count: int = 15,
    rays: int = 4000,
    object_distance: float | None = None,
) -> RMSCurves:
    """Compute RMS spot radii at evenly spaced wavelengths.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        interval: shortest and longest wavelength, nm; None for those of the lens.
        count: wavelengths, with both ends.
        rays: of each spot, a multiple of four, before apertures clip any.
        object_distance: mm in front of the first vertex; None for an object at infinity.

    Raises:
        InputError: no interval is given and the lens has no wavelengths, or fewer than two are
            asked for.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 wavelengths, not {count}")
    if interval is None:
        if not lens.wavelengths:
            raise InputError(f"lens '{lens.name}' names no wavelengths: give an interval")
        interval = min(lens.wavelengths), max(lens.wavelengths)
    wavelengths = torch.linspace(*interval, count, dtype=torch.float64)
    return _curves(lens, fields, wavelengths, rays, object_distance, None)


def _curves(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    rays: int,
    object_distance: float | None,
    wavelength_weights: Sequence[float] | None,
) -> RMSCurves:
    spots = spot_diagram(lens, fields, wavelengths, rays, object_distance, wavelength_weights)
    return RMSCurves(
        spots.fields,
        spots.field_unit,
        spots.wavelengths,
        spots.rms,
        spots.polychromatic_rms,
        spots.airy_radius,
    )


def _largest(lens: Lens, object_distance: float | None) -> tuple[float, float]:
    kind = "angles" if object_distance is None else "heights"
    if lens.fields is None or lens.fields.kind != kind:
        raise InputError(f"lens '{lens.name}' has no fields that are {kind}: give the field's edge")
    return max(lens.fields.points, key=lambda point: point[0] ** 2 + point[1] ** 2)
