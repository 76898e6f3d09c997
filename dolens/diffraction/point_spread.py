"""Point spread functions, encircled energy and Strehl ratios of a lens's fields."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.encircled_energy import EncircledEnergy, checked_radii
from dolens.analysis.spot_diagram import AIRY, working_f_numbers
from dolens.diffraction.element_spread import field_spreads
from dolens.diffraction.field_pupil import AIRY_STEPS, MOST_STEPS, FieldPupil
from dolens.diffraction.field_wavefronts import PreparedPupils, prepare_pupils
from dolens.diffraction.wavefront_map import wavefront_errors
from dolens.errors import InputError
from dolens.optics.lens import Lens

_CELLS = 128


@dataclass(frozen=True)
class PointSpread(AtConditions):
    """Point spread functions of F fields, of all wavelengths together; float64 on the CPU.

    Attributes:
        centre: (F, 2), mm on the sensor, of the windows: the centroids of the light.
        half_width_um: (F,), µm, from the centre to the sides of the window.
        irradiance: (F, M, M), share of the light per µm², the mean over a cell of the window; rows
            run along +y and columns along +x.  NaN where no light passes.
        held: (F,), share of the light inside the window.
        strehl_ratio: (F,), highest irradiance over that of the same pupil without aberrations; NaN
            where rays alone make the image.
        airy_radius_um: µm, 1.22·λ·N with the paraxial working F-number, mean over wavelengths.
        diffraction: whether diffraction is part of each field's image, or rays alone make it.
        reasons: why, of each.
        sampling_error: (F,), of the irradiance, over its peak: the largest change by a second
            computation with a coarser pupil (see `point_spread`); NaN where rays alone are used.
    """

    centre: Tensor
    half_width_um: Tensor
    irradiance: Tensor
    held: Tensor
    strehl_ratio: Tensor
    airy_radius_um: float
    diffraction: tuple[bool, ...]
    reasons: tuple[str, ...]
    sampling_error: Tensor


class FieldPointSpread(NamedTuple):
    """A field has these entries in a `PointSpread`; the irradiance is (M, M), per µm²."""

    half_width_um: float
    irradiance: Tensor
    held: float
    strehl_ratio: float
    diffraction: bool
    reason: str
    sampling_error: float

    @classmethod
    def dark(cls, cells: int) -> "FieldPointSpread":
        """Return the entries of a field without light."""
        unknown = torch.full((cells, cells), math.nan, dtype=torch.float64)
        return cls(math.nan, unknown, math.nan, math.nan, False, "no light passes", math.nan)


def of_all_fields(
    where: Conditions, centre: Tensor, airy_radius_um: float, rows: Sequence[FieldPointSpread]
) -> PointSpread:
    """Return the point spread functions of all fields.

    Args:
        where: the conditions that they were computed under.
        centre: (F, 2), mm on the sensor, of their windows.
        airy_radius_um: µm.
        rows: one for each field.
    """

    def numbers(values: Iterable[float]) -> Tensor:
        return torch.tensor(list(values), dtype=torch.float64)

    return PointSpread(
        where,
        centre,
        numbers(row.half_width_um for row in rows),
        torch.stack([row.irradiance.cpu() for row in rows]),
        numbers(row.held for row in rows),
        numbers(row.strehl_ratio for row in rows),
        airy_radius_um,
        tuple(row.diffraction for row in rows),
        tuple(row.reason for row in rows),
        numbers(row.sampling_error for row in rows),
    )


@torch.no_grad()
def point_spread(
    lens: Lens,
    where: Conditions,
    cells: int = _CELLS,
    half_width_um: float | None = None,
    prepared: PreparedPupils | None = None,
) -> PointSpread:
    """Compute the point spread function of every field, by the Fourier transform of its pupil.

    Where the wavefront is too steep for that, rays alone make the image; `reasons` says so.  The
    sampling error is estimated by a second transform of half of the pupil's samples.  Behind a
    diffractive element light goes as `dolens.diffraction.element_waves` says.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        cells: M, along each side of the window.
        half_width_um: µm, of all windows; None: each holds 99 % of its rays and some rings around.

    Rarely needed:
        prepared: `prepare_pupils` of the same arguments, where several analyses share it.

    Raises:
        InputError: fewer than two cells, or a window without width.
    """
    if cells < 2 or (half_width_um is not None and not half_width_um > 0.0):
        raise InputError(f"a window needs two cells and a positive width, not {cells}")
    if lens.system().diffractive:
        return _behind_element(lens, where, cells, half_width_um)
    prepared = prepared or prepare_pupils(lens, where)
    rows = []
    for pupil in prepared.pupils:
        if pupil is None:
            rows.append(FieldPointSpread.dark(cells))
            continue
        half = pupil.window_half_width if half_width_um is None else 1e-3 * half_width_um
        irradiance, peak, perfect = pupil.mean_irradiance(half, cells)
        held = float(irradiance.sum()) * (2.0 * half / cells) ** 2
        how = pupil.diffraction, pupil.reason, pupil.sampling_error(half, cells)
        row = FieldPointSpread(1e3 * half, 1e-6 * irradiance, held, peak / perfect, *how)
        rows.append(row)
    found = prepared.wavefronts
    return of_all_fields(found.where, found.centre, airy_radius_um(lens, found.where), rows)


def _behind_element(
    lens: Lens, where: Conditions, cells: int, half_width_um: float | None
) -> PointSpread:
    """Return the point spread functions of a lens with a diffractive element, all its orders."""
    where = where.that_count()
    rows, centres, airy = [], [], []
    for light in field_spreads(lens, where):
        centres.append(light.centre[0].cpu())
        if not light.lit:
            rows.append(FieldPointSpread.dark(cells))
            continue
        airy.append(light.airy_radius_um)
        half = 1e-3 * half_width_um if half_width_um else light.half_width
        means, peak, perfect = light.mean_irradiance(half, cells)
        held = float(means.sum()) * (2.0 * half / cells) ** 2
        how = peak / perfect, True, light.reason(half), light.sampling_error(half, means)
        rows.append(FieldPointSpread(1e3 * half, 1e-6 * means, held, *how))
    radius = airy[0] if airy else math.nan
    return of_all_fields(where, torch.stack(centres), radius, rows)


@torch.no_grad()
def diffraction_encircled_energy(
    lens: Lens,
    where: Conditions,
    radii_um: Sequence[float] | Tensor | None = None,
    prepared: PreparedPupils | None = None,
) -> EncircledEnergy:
    """Compute encircled energy with diffraction, by sums over the point spread function.

    Light outside the window counts: the whole is what passes the pupil.  Fields whose wavefront is
    too steep have that of their rays.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        radii_um: (Q,), µm, ascending, from the centroid; None for 101 from zero to the edge of the
            largest window of `point_spread`.

    Rarely needed:
        prepared: `prepare_pupils` of the same arguments, where several analyses share it.

    Raises:
        InputError: radii that do not ascend.
    """
    prepared = prepared or prepare_pupils(lens, where)
    found, pupils = prepared.wavefronts, prepared.pupils
    airy = airy_radius_um(lens, found.where)
    if radii_um is None:
        reach = max((pupil.window_half_width for pupil in pupils if pupil), default=4e-3 * airy)
        radii_um = torch.linspace(0.0, 1e3 * reach, 101, dtype=torch.float64)
    radii = checked_radii(radii_um)
    curves = [
        torch.full_like(radii, math.nan) if pupil is None else _encircled(pupil, 1e-3 * radii)
        for pupil in pupils
    ]
    return EncircledEnergy(
        found.where,
        radii,
        torch.stack(curves).cpu(),
        airy,
        tuple(pupil is not None and pupil.diffraction for pupil in pupils),
    )


# Windows of its own that a field's encircled energy is followed for.
_FAR = 4.0


def _encircled(pupil: FieldPupil, radii: Tensor) -> Tensor:
    """Return the shares (Q,) of a field's light within radii in mm."""
    radii = radii.to(pupil.weights)
    if not pupil.diffraction:
        return pupil.encircled_rays(radii)
    # Far beyond its window, as the spot of another field may need, a field's curve stays level.
    widest = _FAR * pupil.window_half_width
    half = min(float(radii[-1]), widest) + 1e-9
    radii = radii.clamp(max=widest)
    wanted = math.ceil(2.0 * half * AIRY_STEPS / pupil.airy_radius)
    cells = min(max(wanted, 2 * _CELLS), MOST_STEPS)
    step = 2.0 * half / cells
    grid = (torch.arange(cells).to(pupil.weights) + 0.5) * step - half
    light = pupil.irradiance(grid, grid)[0].flatten() * step * step
    distance = torch.hypot(grid[:, None], grid[None]).flatten()
    # A cell that the circle cuts counts by the part that lies inside.
    order = distance.argsort()
    distance, within = distance[order], light[order].cumsum(0)
    within = torch.cat([within.new_zeros(1), within])
    inner = torch.searchsorted(distance, radii - 0.5 * step)
    outer = torch.searchsorted(distance, radii + 0.5 * step)
    found = []
    for radius, low, high in zip(radii, inner.tolist(), outer.tolist(), strict=True):
        edge = light[order[low:high]]
        share = ((radius - distance[low:high]) / step + 0.5).clamp(0.0, 1.0)
        found.append(within[low] + (edge * share).sum())
    return torch.stack(found)


def airy_radius_um(lens: Lens, where: Conditions) -> float:
    """Return 1.22·λ·N, µm, with the paraxial working F-number, mean over wavelengths."""
    radii = 1e-3 * AIRY * where.wavelengths * working_f_numbers(lens, where)
    return float(where.weights @ radii)


# Of a point spread function's window, whose peak alone counts.
_PEAK_CELLS = 64


@dataclass(frozen=True)
class StrehlRatios(AtConditions):
    """Strehl ratios of F fields at W wavelengths, each alone, on the sensor as it stands.

    Attributes:
        peak: (F, W), highest irradiance of the point spread function over that of the same pupil
            without aberrations (Strehl); NaN where no light passes, or where the wavefront is too
            steep for diffraction.
        marechal: (F, W), exp(-(2πσ)²), σ being the RMS wavefront error in waves about its best tilt
            and piston (Maréchal's, as Mahajan has it; good above some 0.3).
        sampling_error: (F, W), of the point spread function; see `point_spread`.
    """

    peak: Tensor
    marechal: Tensor
    sampling_error: Tensor


@torch.no_grad()
def strehl_ratios(lens: Lens, where: Conditions) -> StrehlRatios:
    """Compute Strehl ratios of every field and wavelength in both ways.

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.

    Raises:
        InputError: a sphere that cannot be placed.
    """
    errors = wavefront_errors(lens, where)
    peak, sampling = [], []
    for wavelength in where.wavelengths.tolist():
        found = point_spread(lens, where.at(wavelengths=wavelength), cells=_PEAK_CELLS)
        peak.append(found.strehl_ratio)
        sampling.append(found.sampling_error)
    return StrehlRatios(
        where,
        torch.stack(peak, -1),
        marechal(errors.rms),
        torch.stack(sampling, -1),
    )


def marechal(rms: Tensor) -> Tensor:
    """Return exp(-(2πσ)²) of RMS wavefront errors σ in waves."""
    return (-(2.0 * torch.pi * rms).square()).exp()
