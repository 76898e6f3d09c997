"""The modulation transfer function with diffraction, from the pupil's autocorrelation."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.modulation_transfer import field_directions, modulation
from dolens.diffraction.element_spread import field_spreads
from dolens.diffraction.field_pupil import COARSER
from dolens.diffraction.field_wavefronts import PreparedPupils, prepare_pupils
from dolens.diffraction.point_spread import PointSpread, point_spread
from dolens.optics.lens import Lens

# Samples across the pupil beyond which rays alone are used: a spot of some 300 Airy radii.
_MOST_SAMPLES = 1024
# Of each spot of a draft.
_DRAFT_RAYS = 2000


@dataclass(frozen=True)
class DiffractionModulation(AtConditions):
    """MTF with diffraction of F fields at Q frequencies, of all wavelengths; float64 on the CPU.

    Attributes:
        frequencies: (Q,), cycles/mm on the sensor.
        tangential: (F, Q), of a pattern that varies along the field's own direction, y for one in
            the y-z plane and on the axis; NaN where no light passes.
        sagittal: (F, Q), of one that varies across it.
        tangential_limit: (F, Q), of the same pupil without aberrations; NaN where rays alone are
            used.
        sagittal_limit: (F, Q).
        diffraction: whether diffraction is part of it, or rays alone, of each field.
        reasons: why, of each.
        sampling_error: (F,), the largest change of either curve by a second computation with half
            of the pupil's samples (or half of the rays, where these alone are used); NaN where no
            light passes, and of a draft.
        draft: whether it is a draft; see `diffraction_modulation`.
    """

    frequencies: Tensor
    tangential: Tensor
    sagittal: Tensor
    tangential_limit: Tensor
    sagittal_limit: Tensor
    diffraction: tuple[bool, ...]
    reasons: tuple[str, ...]
    sampling_error: Tensor
    draft: bool = False


@torch.no_grad()
def diffraction_modulation(
    lens: Lens,
    where: Conditions,
    frequencies: Sequence[float] | Tensor,
    prepared: PreparedPupils | None = None,
    draft: bool = False,
) -> DiffractionModulation:
    """Compute the polychromatic MTF with diffraction.

    Where a wavefront is too steep for a Fourier transform of the pupil, the field has the geometric
    MTF of its rays; `reasons` says so.  Behind a diffractive element it is that of its point spread
    functions.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        frequencies: (Q,), cycles/mm.

    Rarely needed:
        prepared: `prepare_pupils` of the same arguments, where several analyses share it.
        draft: leave out the second computation, which knows the sampling error, and leave spots of
            more than some 50 Airy radii to the rays of `analysis.modulation_transfer.modulation`,
            2000 for each wavelength.
    """
    if lens.system().diffractive:
        return modulation_of_windows(
            where,
            frequencies,
            lambda here: _element_window(lens, here),
            lambda here, cells, half_um: point_spread(lens, here, cells, half_um),
        )
    prepared = prepared or prepare_pupils(lens, where, _MOST_SAMPLES, draft)
    found, pupils = prepared.wavefronts, prepared.pupils
    frequency = torch.as_tensor(frequencies, dtype=torch.float64, device=lens.device).reshape(-1)
    dark = torch.full_like(frequency, math.nan).expand(4, -1)
    along = field_directions(found.where).to(lens.device)
    rows, errors = [], []
    by_rays = _by_rays(lens, prepared, frequency) if draft else {}
    for number, (pupil, way) in enumerate(zip(pupils, along, strict=True)):
        if pupil is None:
            rows.append(dark)
            errors.append(math.nan)
            continue
        if number in by_rays:
            rows.append(torch.cat([by_rays[number], dark[:2]]))
            errors.append(math.nan)
            continue
        found_here, limit = pupil.transfer(frequency, way)
        rows.append(torch.cat([found_here.abs(), limit]))
        if draft:
            errors.append(math.nan)
            continue
        coarser, _ = pupil.transfer(frequency, way, COARSER)
        errors.append(float((found_here.abs() - coarser.abs()).abs().amax()))
    tangential, sagittal, *limits = torch.stack(rows, 1).cpu()
    return DiffractionModulation(
        found.where,
        frequency.cpu(),
        tangential,
        sagittal,
        limits[0],
        limits[1],
        tuple(pupil is not None and pupil.diffraction for pupil in pupils),
        tuple("no light passes" if pupil is None else pupil.reason for pupil in pupils),
        torch.tensor(errors, dtype=torch.float64),
        draft,
    )


def _element_window(lens: Lens, where: Conditions) -> tuple[float, float]:
    """Return half width and Airy radius, µm, of the window of a field behind an element."""
    (light,) = field_spreads(lens, where)
    return 1e3 * light.half_width, light.airy_radius_um


def _by_rays(lens: Lens, prepared: PreparedPupils, frequency: Tensor) -> dict[int, Tensor]:
    """Return tangential and sagittal curves (2, Q) of the fields that diffraction is no part of."""
    pupils, where = prepared.pupils, prepared.wavefronts.where
    numbers = [n for n, pupil in enumerate(pupils) if pupil and not pupil.diffraction]
    if not numbers:
        return {}
    found = modulation(lens, where.at(where.fields[numbers]), frequency, _DRAFT_RAYS)
    curves = torch.stack((found.tangential, found.sagittal), 1).to(frequency)
    return dict(zip(numbers, curves, strict=True))


# Airy radii that the window is wider, on every side, than that of a point spread function; and
# points of the image to an Airy radius: three leave the copies of a spectrum that ends at 1.22 over
# the radius well apart.
_AIRY_RADII, _STEPS = 4.0, 3.0


@torch.no_grad()
def modulation_of_windows(
    where: Conditions,
    frequencies: Sequence[float] | Tensor,
    window: Callable[[Conditions], tuple[float, float]],
    spread: Callable[[Conditions, int, float], PointSpread],
) -> DiffractionModulation:
    """Compute the polychromatic MTF from point spread functions.

    Light that falls beyond a window is missing in the modulation, which is that of all light.

    Args:
        where: fields, wavelengths with their weights, and object distance.
        frequencies: (Q,), cycles/mm.
        window: conditions of one field → half width of its window, and its Airy radius, µm.
        spread: conditions of one field, cells a side, and half width (µm) → the function.

    Returns:
        The curves; the limits, which need a second pupil, are NaN.
    """
    frequency = torch.as_tensor(frequencies, dtype=torch.float64).cpu().reshape(-1)
    unknown = torch.full_like(frequency, math.nan)
    curves: list[Tensor] = []
    errors: list[float] = []
    diffraction: list[bool] = []
    reasons: list[str] = []
    for field, way in zip(where.fields, field_directions(where), strict=True):
        here = where.at(field[None])
        half, airy = window(here)
        half += _AIRY_RADII * airy
        cells = math.ceil(2.0 * half * _STEPS / airy)
        found = spread(here, cells, half)
        reasons += found.reasons
        diffraction += found.diffraction
        if not found.diffraction[0]:
            curves.append(torch.stack((unknown, unknown)))
            errors.append(math.nan)
            continue
        ways = torch.stack((way, torch.stack((way[1], -way[0]))))
        curves.append(_transform(found.irradiance[0], float(found.half_width_um), frequency, ways))
        errors.append(float(found.sampling_error) + abs(1.0 - float(found.held)))
    tangential, sagittal = torch.stack(curves, 1)
    limit = unknown.expand(len(where.fields), -1)
    return DiffractionModulation(
        where.that_count(),
        frequency,
        tangential,
        sagittal,
        limit,
        limit,
        tuple(diffraction),
        tuple(reasons),
        torch.tensor(errors, dtype=torch.float64),
    )


def _transform(irradiance: Tensor, half_um: float, frequency: Tensor, ways: Tensor) -> Tensor:
    """Return |∬E·exp(-2πi·ν·(p·way))|, (2, Q), of irradiance (M, M) in shares per µm²."""
    cells = len(irradiance)
    step = 2.0 * half_um / cells
    place = 1e-3 * ((torch.arange(cells).to(irradiance) + 0.5) * step - half_um)
    found = []
    for x, y in ways.tolist():
        # exp(-2πi·ν·(x·X + y·Y)) is a product of one of columns and one of rows.
        across, down = (
            torch.polar(torch.ones_like(phase), phase)
            for phase in (-2.0 * math.pi * frequency[:, None] * w * place for w in (x, y))
        )
        sums = ((down @ irradiance.to(down)) * across).sum(-1)
        found.append(step * step * sums.abs())
    return torch.stack(found)
