"""Wavefront errors: maps over the stop, Zernike coefficients, RMS and peak to valley."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.zernike_fit import TERMS, ZernikeFit, zernike_fit
from dolens.diffraction.entrance_beam import (
    EntranceBeam,
    ObjectPoints,
    box_grid,
    find_beam,
    launched,
)
from dolens.diffraction.field_wavefronts import field_wavefronts, light_centroids, object_points
from dolens.diffraction.reference_sphere import find_chief_rays
from dolens.diffraction.wavefront import MM_PER_NM, RIM, cell_areas, pupil_wavefront
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays
from dolens.optics.system import OpticalSystem


@dataclass(frozen=True)
class WavefrontMaps(AtConditions):
    """Wavefront errors of F fields and W wavelengths at S × S rays each; float64 on the CPU.

    The wavefront error W is measured on a sphere about the point of the sensor where the chief ray
    of the same wavelength lands, through the centre of the paraxial exit pupil.  W is positive
    where the wavefront is ahead of the sphere, as where light arrives early: the sign of Welford
    and of Hopkins, and Optiland's.  It is minus `Wavefront.opd`.  Third-order spherical aberration
    of a simple positive lens has W₀₄₀ > 0 at its paraxial focus.

    Attributes:
        stop: (F, W, S, S, 2), where the rays cross the stop, over its semi-diameter, in its axes;
            the same numbers as the `pupil` of `Lens.aim`.
        error: (F, W, S, S), waves, with a mean of zero over the light; NaN where none passes.
        weight: (F, W, S, S), the ray's cell of the stop times the share of it that passes; its sum
            is one, and every part of the stop counts alike.
        inside: (F, W, S, S), bool: the ray itself passes; of an edge's cells some rays do not.
        by_chief_ray: (F, W), bool: the sphere is about the chief ray's point; else, where that ray
            does not arrive, about the centroid of the light.
    """

    stop: Tensor
    error: Tensor
    weight: Tensor
    inside: Tensor
    by_chief_ray: Tensor

    @property
    def rms(self) -> Tensor:
        """(F, W), waves, about the mean; NaN where no light passes."""
        square = self.error.square().nan_to_num(0.0)
        return (self.weight * square).sum((-2, -1)).sqrt() + self._dark

    @property
    def peak_to_valley(self) -> Tensor:
        """(F, W), waves, over the rays that pass."""
        high = self.error.where(self.inside, -torch.inf).amax((-2, -1))
        low = self.error.where(self.inside, torch.inf).amin((-2, -1))
        return (high - low).clamp(min=0.0) + self._dark

    def zernike(self, order: str = "fringe", count: int = TERMS) -> ZernikeFit:
        """Fit Zernike polynomials over the disc of the stop; (F, W) fits, in waves.

        Args:
            order: `fringe` or `standard`.
            count: terms.
        """
        error, weight = self.error.flatten(2), self.weight.flatten(2)
        x, y = self.stop.flatten(2, 3).unbind(-1)
        return zernike_fit(error.nan_to_num(0.0), x, y, weight, order, count)

    @property
    def _dark(self) -> Tensor:
        return torch.where(self.weight.sum((-2, -1)) > 0.0, 0.0, torch.nan)


@torch.no_grad()
def wavefront_maps(lens: Lens, where: Conditions, samples: int = 64) -> WavefrontMaps:
    """Trace the wavefront error of every field and wavelength; see `WavefrontMaps`.

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.
        samples: S, rays along each side of a box about each beam.

    Raises:
        InputError: a sphere that cannot be placed.
    """
    system = lens.system().double()
    field, waves = where.fields.to(system.device), where.wavelengths.to(system.device)
    shape = (len(field), len(waves))
    points = object_points(field.repeat_interleave(len(waves), 0), where.object_distance)
    wave = waves.repeat(len(field))
    beam = find_beam(system, points, wave)
    centre, reached = find_chief_rays(system, points, wave)
    if not bool(reached.all()):
        middle = light_centroids(system, points, wave, beam)
        centre = torch.where(reached[:, None], centre, middle)
    front = pupil_wavefront(system, points, wave, centre, samples, beam=beam)
    stop, cell = stop_coordinates(system, points, wave, beam, samples)
    weight = (cell * front.coverage).where(front.valid & stop.isfinite().all(-1), 0.0)
    weight = weight / weight.sum((-2, -1), keepdim=True)
    weight = weight.nan_to_num(0.0)
    mean = (weight * front.opd).sum((-2, -1), keepdim=True)
    error = -(front.opd - mean) / (MM_PER_NM * wave[:, None, None])

    def found(values: Tensor) -> Tensor:
        return values.cpu().unflatten(0, shape)

    return WavefrontMaps(
        where,
        found(stop),
        found(error.where(weight > 0.0, torch.nan)),
        found(weight),
        found((weight > 0.0) & (front.coverage >= 0.5)),
        found(reached),
    )


def stop_coordinates(
    system: OpticalSystem, points: ObjectPoints, wave: Tensor, beam: EntranceBeam, samples: int
) -> tuple[Tensor, Tensor]:
    """Return where the rays of `pupil_wavefront` cross the stop over its semi-diameter,
    (N, S, S, 2), and the areas of their cells there, (N, S, S).
    """
    half_width = beam.half_width * (samples / (samples - 2.0))
    q = box_grid(beam.centre, half_width, samples, RIM)
    rays = Rays.from_components(launched(points, q), wave[:, None, None])
    hit = trace_rays(system.opened(), rays, last=system.stop)
    there = from_lens_axes(hit.components(), system.axes[system.stop - 1])
    radius = system.surfaces[system.stop - 1].semi_diameter
    stop = torch.stack((there.x, there.y), -1) / radius
    return stop[:, RIM:-RIM, RIM:-RIM], cell_areas(stop)


@dataclass(frozen=True)
class WavefrontErrors(AtConditions):
    """Wavefront errors of F fields and W wavelengths; NaN where no light passes.

    Attributes:
        rms: (F, W), waves, about the best tilt and piston, focus left as it is on the sensor.
        peak_to_valley: (F, W), waves, over the rays that pass, about the same.
        strehl_ratio: (F, W), irradiance where that tilt points over that of a perfect wavefront.
    """

    rms: Tensor
    peak_to_valley: Tensor
    strehl_ratio: Tensor


@torch.no_grad()
def wavefront_errors(lens: Lens, where: Conditions, samples: int = 64) -> WavefrontErrors:
    """Compute RMS wavefront error, peak to valley and Strehl ratio on the sensor.

    Tilt, which only moves the image point, is removed by least squares over the pupil.  The Strehl
    ratio is |∫A·exp(ik·OPD)|²/(∫A)², and exp(-(2π·rms)²) where errors are small (Maréchal).

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.
        samples: rays along each side of a box about each beam.

    Raises:
        InputError: a sphere that cannot be placed.
    """
    found = field_wavefronts(lens, where, samples)
    front, shape = found.wavefront, found.lit.shape
    weight = front.weight.flatten(1)
    share = (weight / weight.sum(1, keepdim=True)).nan_to_num(0.0)
    basis = torch.cat([torch.ones_like(share)[..., None], front.direction.flatten(1, 2)], -1)
    waves = front.waves.flatten(1)
    root = share.sqrt()[..., None]
    tilt = torch.linalg.pinv(root * basis) @ (root * waves[..., None])
    error = waves - (basis @ tilt)[..., 0]
    lit = (front.coverage.flatten(1) >= 0.5) & front.valid.flatten(1)
    high = error.where(lit, -torch.inf).amax(1)
    low = error.where(lit, torch.inf).amin(1)
    phase = 2.0 * torch.pi * error
    real, imaginary = (share * phase.cos()).sum(1), (share * phase.sin()).sum(1)

    def values(of: Tensor) -> Tensor:
        return of.cpu().unflatten(0, shape).where(found.lit, torch.nan)

    return WavefrontErrors(
        where,
        values((share * error.square()).sum(1).sqrt()),
        values((high - low).clamp(min=0.0)),
        values(real.square() + imaginary.square()),
    )
