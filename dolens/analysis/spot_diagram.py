"""Spot diagrams show the ray intercepts of an object point; RMS radii measure their spread, also
over the field and the wavelength.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.ray_intercepts import AimedAtStop, trace_ray_intercepts
from dolens.errors import InputError
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order

# First zero of Bessel's J₁ over π; Airy's radius is 1.22·λ·N.
AIRY = 1.2196698912665045


@dataclass(frozen=True)
class SpotDiagram(AtConditions):
    """A `SpotDiagram` holds spots of F fields and W wavelengths by N points of the stop, in double
    precision on the CPU.

    Values of fields or wavelengths that no light reaches are NaN.

    Attributes:
        intercepts: (F, W, N, 2), mm on the sensor; NaN for rays that do not pass.
        valid: (F, W, N), bool.
        weight: (N,), share of a ray in the light through the stop; zero for rays on its rim.
        chief: (F, 2), mm, intercept of the chief ray of the reference wavelength.
        centroid: (F, W, 2), mm.
        rms: (F, W), mm, √(Σ w·|p - p̄|²) about the spot's own centroid.
        geo: (F, W), mm, the largest |p - p̄|; over the rim of the stop too, but no nearer to an edge
            that another aperture makes than the rays are apart.
        polychromatic_centroid: (F, 2), mm, of all wavelengths together.
        polychromatic_rms: (F,), mm, about that.
        airy_radius: (W,), mm, 1.22·λ·N with the paraxial working F-number of the stop.
    """

    intercepts: Tensor
    valid: Tensor
    weight: Tensor
    chief: Tensor
    centroid: Tensor
    rms: Tensor
    geo: Tensor
    polychromatic_centroid: Tensor
    polychromatic_rms: Tensor
    airy_radius: Tensor


@torch.no_grad()
def spot_diagram(
    lens: Lens, where: Conditions, rays: int = 2000, aimed: AimedAtStop | None = None
) -> SpotDiagram:
    """Trace rays spread uniformly over the stop, at every field and wavelength.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        rays: of each spot, a multiple of four, before apertures clip any.  RMS radii of two
            thousand err by some 1e-4 of themselves where only the stop clips, and by a few
            hundredths at the edge of a field that has lost most of its light.

    Rarely needed:
        aimed: `aimed_at_stop` of the same arguments, where several analyses share it.

    Raises:
        InputError: a wrong number of rays.
    """
    lens = in_double_precision(lens)
    pupil, weight = uniform_pupil_points(rays)
    intercepts = trace_ray_intercepts(lens, where, pupil, aimed=aimed)
    points, valid = intercepts.points, intercepts.valid

    light = weight * intercepts.light
    centroid, mean_square = moments(points, light)
    extent = (points - centroid[:, :, None]).norm(dim=-1).nan_to_num(-math.inf).amax(-1)
    every = (light * where.weights[:, None]).flatten(1, 2)
    common, common_square = moments(points.flatten(1, 2), every)
    return SpotDiagram(
        where=where,
        intercepts=points,
        valid=valid,
        weight=weight,
        chief=intercepts.chief,
        centroid=centroid,
        rms=mean_square.sqrt(),
        geo=extent.where(extent >= 0.0, math.nan),
        polychromatic_centroid=common,
        polychromatic_rms=common_square.sqrt(),
        airy_radius=AIRY * where.wavelengths * 1e-6 * working_f_numbers(lens, where),
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


def working_f_numbers(lens: Lens, where: Conditions) -> Tensor:
    """Return the paraxial working F-number at each wavelength, (W,), positive."""
    system = lens.system()
    numbers = [
        first_order(system, wavelength, where.object_distance).working_f_number.abs()
        for wavelength in where.wavelengths.tolist()
    ]
    return torch.stack(numbers).detach().double().cpu()


@dataclass(frozen=True)
class RMSCurves(AtConditions):
    """An `RMSCurves` holds RMS spot radii of F fields and W wavelengths; NaN where no light passes.

    Attributes:
        rms: (F, W), mm, about each spot's own centroid.
        polychromatic: (F,), mm, of all wavelengths together about their common centroid.
        airy_radius: (W,), mm.
    """

    rms: Tensor
    polychromatic: Tensor
    airy_radius: Tensor


def rms_against_field(
    lens: Lens,
    where: Conditions,
    edge: Sequence[float] | Tensor | None = None,
    count: int = 15,
    rays: int = 4000,
) -> RMSCurves:
    """Compute RMS spot radii at evenly spaced fields from the axis to an edge.

    Args:
        lens: the lens.
        where: wavelengths with their weights, of the polychromatic spot, and object distance.
        edge: (x, y) in degrees or mm; None for the farthest field.
        count: fields, with the axis and the edge.
        rays: of each spot, a multiple of four, before apertures clip any.

    Raises:
        InputError: fewer than two fields are asked for.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 fields, not {count}")
    farthest = where.fields[int(where.fields.norm(dim=-1).argmax())]
    last = farthest if edge is None else torch.as_tensor(edge, dtype=torch.float64)
    share = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    return _curves(lens, where.at(share[:, None] * last), rays)


def rms_against_wavelength(
    lens: Lens,
    where: Conditions,
    interval: tuple[float, float] | None = None,
    count: int = 15,
    rays: int = 4000,
) -> RMSCurves:
    """Compute RMS spot radii at evenly spaced wavelengths.

    Args:
        lens: the lens.
        where: fields and object distance.
        interval: shortest and longest wavelength, nm; None for those of the lens.
        count: wavelengths, with both ends.
        rays: of each spot, a multiple of four, before apertures clip any.

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
    return _curves(lens, where.at(wavelengths=wavelengths), rays)


def _curves(lens: Lens, where: Conditions, rays: int) -> RMSCurves:
    spots = spot_diagram(lens, where, rays)
    return RMSCurves(where, spots.rms, spots.polychromatic_rms, spots.airy_radius)
