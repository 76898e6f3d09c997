"""The pupils of one field's wavelengths, from which its point spread function and its optical
transfer function are computed.

Where a Fourier transform of the pupil holds, diffraction is part of the image.  Where the wavefront
is too steep for it (a spot of hundreds of Airy discs), or the edge of the pupil is made by rays
that miss a surface, rays alone make the image; `reason` says which.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.propagation import choose_propagation, fourier_field
from dolens.diffraction.pupil_fit import (
    PupilFit,
    RegularPupil,
    at_points,
    chebyshev,
    fit_pupil,
    regular_pupil,
)
from dolens.diffraction.wavefront import MM_PER_NM, Wavefront, coverage, pupil_wavefront
from dolens.optics.system import OpticalSystem

# Fewest samples across the pupil.
_FEWEST = 128
_OVERSAMPLING = 1.5
# Degrees of the fit that are tried, and the waves that the first may leave.
_DEGREES, _RESIDUAL = (10, 16), 0.005
# Rays along each side of a beam where rays alone are used.
_RAYS = 384
# Samples a side of a second computation, with half as many, over the first's: the difference is the
# first's error where that falls with the square of their distance.
COARSER = 2.0**-0.5
# Share of the light whose rays the window of a point spread function holds.
_HELD = 0.99
# A window holds the rays and so many Airy radii around them.
_BEYOND, _AIRY_RADII = 1.1, 3.5
# Fewest steps of the irradiance's grid to an Airy radius, and most across a window.
AIRY_STEPS, MOST_STEPS = 3.5, 512
# Points of the line that rays are counted on for their transfer function, and points of a pupil
# that are evaluated at a time.
_LINE, _PIECE = 4096, 1 << 14


@dataclass(frozen=True)
class FieldPupil:
    """The pupils of one field at W wavelengths.

    Attributes:
        front: W wavefronts about one point of the sensor.
        weights: (W,), of the wavelengths.
        fit: of the wavefronts; None where rays alone are used.
        reason: why diffraction is part of the image or not.
    """

    front: Wavefront
    weights: Tensor
    fit: PupilFit | None
    reason: str

    @classmethod
    def of(
        cls,
        system: OpticalSystem,
        point: ObjectPoints,
        front: Wavefront,
        weights: Tensor,
        most_samples: int,
        rays: int = _RAYS,
    ) -> "FieldPupil":
        """Choose how light is propagated, by wavefronts of 32 rays a side or more.

        Args:
            system: the lens, in double precision.
            point: W times the field's.
            front: W wavefronts.
            weights: (W,).
            most_samples: across the pupil, beyond which rays alone are used.
            rays: of these, along each side of the beam; none leaves those of `front`.
        """
        fit = fit_pupil(front, _DEGREES[0])
        if not bool((fit.residual <= _RESIDUAL).all()):
            fit = fit_pupil(front, _DEGREES[1])
        found = cls(front, weights, fit, "")
        reason = found._obstacle(most_samples)
        if not reason:
            return replace(found, reason="Fourier transform of the pupil")
        if rays:
            # An infinite sphere is met by all rays, however far they land from its centre.
            front = pupil_wavefront(system, point, front.wavelength, front.centre, rays, math.inf)
        return cls(front, weights, None, f"rays alone: {reason}")

    @property
    def diffraction(self) -> bool:
        """Return whether diffraction is part of the image."""
        return self.fit is not None

    @property
    def airy_radius(self) -> float:
        """Return 0.61·λ over half the pupil's width in direction cosines, mm; the largest of all
        wavelengths and the smaller width count.
        """
        lit = self.front.coverage > 0.0
        cosine = self.front.direction
        high = torch.where(lit[..., None], cosine, -math.inf).amax((1, 2))
        low = torch.where(lit[..., None], cosine, math.inf).amin((1, 2))
        wave = MM_PER_NM * self.front.wavelength / self.front.index
        width = (high - low).amin(-1).clamp(min=1e-9)
        return float((1.22 * wave / width).amax())

    @property
    def spot_radius(self) -> float:
        """Return the radius (mm) about the centre that holds 99 % of the light by rays."""
        distance, light = self._spot()
        order = distance.argsort()
        within = light[order].cumsum(0)
        at = int(torch.searchsorted(within, _HELD * within[-1]))
        return float(distance[order][min(at, len(order) - 1)])

    @property
    def window_half_width(self) -> float:
        """Return the half width (mm) of a window that holds the light."""
        return _BEYOND * self.spot_radius + _AIRY_RADII * self.airy_radius

    def mean_irradiance(self, half: float, cells: int) -> tuple[Tensor, float, float]:
        """Return means over the cells of a window (M, M), 1/mm², the highest irradiance, and a
        perfect lens's, NaN where rays alone make the image.

        Args:
            half: half width of the window, mm.
            cells: M, along each side.
        """
        parts = 1
        if self.diffraction:
            wanted = math.ceil(2.0 * half * AIRY_STEPS / self.airy_radius / cells)
            parts = max(1, min(wanted, MOST_STEPS // cells))
        fine = parts * cells
        grid = (torch.arange(fine).to(self.weights) + 0.5) * (2.0 * half / fine) - half
        irradiance, perfect = self.irradiance(grid, grid)
        peak = float(irradiance.amax())
        if self.diffraction:
            # The highest point lies between the samples.
            row, column = divmod(int(irradiance.argmax()), fine)
            near = torch.linspace(-1.0, 1.0, 17).to(grid) * (2.0 * half / fine)
            peak = float(self.irradiance(grid[column] + near, grid[row] + near)[0].amax())
        means = irradiance.unflatten(1, (cells, parts)).unflatten(0, (cells, parts)).mean((1, 3))
        return means, peak, perfect

    def changes(self, half: float, cells: int) -> tuple[Tensor, Tensor]:
        """Return the irradiance (M, M), 1/mm², at the centres of a window's cells, and what half of
        the pupil's samples change of it.  Arguments as of `mean_irradiance`.
        """
        grid = (torch.arange(cells).to(self.weights) + 0.5) * (2.0 * half / cells) - half
        fine, coarse = (self.irradiance(grid, grid, share)[0] for share in (1.0, COARSER))
        return fine, fine - coarse

    def sampling_error(self, half: float, cells: int) -> float:
        """Return the largest of these changes over the irradiance's peak; NaN where rays alone make
        the image.
        """
        if not self.diffraction:
            return math.nan
        fine, changes = self.changes(half, cells)
        return float(changes.abs().amax() / fine.amax())

    def irradiance(self, x: Tensor, y: Tensor, share: float = 1.0) -> tuple[Tensor, float]:
        """Compute the irradiance on a regular grid, with the share of the light as unit.

        Args:
            x: (X,), mm from the centre, equally spaced.
            y: (Y,), mm.
            share: of the samples across the pupil that are taken; below one for a coarser look.

        Returns:
            (Y, X), 1/mm², and the Strehl ratio's denominator: the irradiance of a perfect
            wavefront at the centre.  Rays alone give the mean over each cell.
        """
        if self.fit is None:
            return self._counted(x, y), math.nan
        samples = self.samples(float(torch.cat([x.abs(), y.abs()]).amax()))
        pupil = regular_pupil(self.fit, round(share * samples))
        # Phases are formed in double precision; sums in single precision err by 1e-6.
        field = fourier_field(pupil, x, y, torch.float32)
        perfect = _unaberrated(pupil)
        total = self.weights @ pupil.flux
        irradiance = field.real.double().square() + field.imag.double().square()
        mixed = torch.einsum("w,wyx->yx", self.weights, irradiance) / total
        return mixed, float(self.weights @ perfect / total)

    def transfer(
        self, frequencies: Tensor, direction: Tensor, share: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Compute the optical transfer function along and across a direction of the sensor.

        See `autocorrelation.transfer_functions`; rays alone are counted on a fine line.

        Args:
            frequencies: (Q,), cycles/mm.
            direction: (2,), unit vector.
            share: of the samples that are taken, as in `irradiance`; below one, every other ray.

        Returns:
            (2, Q), complex, of all wavelengths, along and across; and (2, Q), the modulus without
            aberrations, NaN where rays alone are used.
        """
        if self.fit is None:
            return self._transfer_of_rays(frequencies, direction, share)
        pupil = self._on_grid(round(share * self.samples(0.0, 2.0)), direction)
        light = self.weights * pupil.flux
        shares = (light / light.sum())[:, None]
        found, limit = [], []
        for axis in range(2):
            aberrated, perfect = transfer_functions(pupil, axis, frequencies)
            found.append((shares * aberrated).sum(0))
            limit.append((shares * perfect).sum(0).abs())
        return torch.stack(found), torch.stack(limit)

    def _transfer_of_rays(
        self, frequencies: Tensor, direction: Tensor, part: float
    ) -> tuple[Tensor, Tensor]:
        light = self.weights[:, None, None] * self.front.amplitude * self.front.weight
        if part < 1.0:
            row = torch.arange(light.shape[-1], device=light.device)
            light = light * ((row[:, None] + row) % 2 == 0)
        lit = light > 0.0
        share, points = light[lit] / light.sum(), self.front.intercept[lit]
        found = []
        for way in (direction, torch.stack((direction[1], -direction[0]))):
            height = points @ way.to(points)
            # Rays are counted on a fine line first: so many do not each need a phase.
            low, high = float(height.amin()), float(height.amax())
            step = (high - low) / _LINE or 1.0
            place = (height - low) / step
            first = place.floor().clamp(max=_LINE - 1.0)
            line = share.new_zeros(_LINE + 1)
            line.index_add_(0, first.long(), share * (1.0 - (place - first)))
            line.index_add_(0, first.long() + 1, share * (place - first))
            at = low + step * torch.arange(_LINE + 1).to(line)
            phase = -2.0 * torch.pi * frequencies[:, None] * at
            found.append(torch.complex(phase.cos() @ line, phase.sin() @ line))
        return torch.stack(found), frequencies.new_full((2, len(frequencies)), math.nan)

    def encircled_rays(self, radii: Tensor) -> Tensor:
        """Return the shares (Q,) of the light whose rays land within radii (mm) of the centre."""
        distance, light = self._spot()
        order = distance.argsort()
        within = torch.cat([light.new_zeros(1), light[order].cumsum(0)])
        return within[torch.searchsorted(distance[order], radii, right=True)] / within[-1]

    def samples(self, half_window: float, spots: float = 1.0) -> int:
        """Return G, samples across the pupil, that keep copies of the image out of a window.

        Args:
            half_window: mm.
            spots: how many times the spot's own extent must fit beside it.
        """
        fit = self._fitted()
        wave = MM_PER_NM * self.front.wavelength / self.front.index
        width = (fit.high - fit.low).amax(-1)
        reach = spots * self._farthest() + half_window
        needed = _OVERSAMPLING * float((width * reach / wave).amax())
        return max(_FEWEST, 4 * math.ceil(needed / 4.0))

    def _fitted(self) -> PupilFit:
        """Return the fit of a pupil that diffracts."""
        assert self.fit is not None
        return self.fit

    def _farthest(self) -> float:
        lit = self.front.coverage >= 0.5
        away = self.front.intercept.abs().amax(-1)
        return float(torch.where(lit, away, 0.0).amax())

    def _obstacle(self, most_samples: int) -> str:
        """Return why a Fourier transform does not hold; nothing where it does."""
        half = 1.1 * self.spot_radius + 4.0 * self.airy_radius
        needed = max(self.samples(half), self.samples(0.0, 2.0))
        if needed > most_samples:
            return f"the wavefront needs {needed} samples across the pupil"
        # Edges are smooth in `coverage`: few samples give the flux to far less than its limit.
        pupil = regular_pupil(self._fitted(), _FEWEST)
        chosen = choose_propagation(self._fitted(), pupil.flux, half)
        reasons = zip(chosen.fourier.tolist(), chosen.reasons, strict=True)
        return next((reason.removeprefix("direct: ") for good, reason in reasons if not good), "")

    def _spot(self) -> tuple[Tensor, Tensor]:
        """Return rays' distances (mm) from the centre, and their light, both (M,)."""
        light = self.weights[:, None, None] * self.front.amplitude * self.front.weight
        lit = light > 0.0
        return self.front.intercept.norm(dim=-1)[lit], light[lit]

    def _counted(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the light of rays in cells about the points of a grid, by bilinear shares."""
        light = self.weights[:, None, None] * self.front.amplitude * self.front.weight
        lit = light > 0.0
        light, points = light[lit] / light.sum(), self.front.intercept[lit]
        step_x, step_y = float(x[1] - x[0]), float(y[1] - y[0])
        column, row = (points[:, 0] - x[0]) / step_x, (points[:, 1] - y[0]) / step_y
        found = light.new_zeros(len(y) * len(x))
        for right in (0, 1):
            for up in (0, 1):
                c, r = column.floor() + right, row.floor() + up
                share = (1.0 - (column - c).abs()) * (1.0 - (row - r).abs())
                inside = (c >= 0) & (c < len(x)) & (r >= 0) & (r < len(y))
                at = (r * len(x) + c)[inside].long()
                found.index_add_(0, at, (light * share)[inside])
        return found.reshape(len(y), len(x)) / (step_x * step_y)

    def _on_grid(self, samples: int, direction: Tensor) -> RegularPupil:
        """Evaluate the pupil on a grid whose last dimension runs along a direction, and the other
        across it; `cosines` are along and across, from the middle.
        """
        fit, front = self._fitted(), self.front
        along = direction.to(fit.low)
        if float(along[0]) == 0.0 or float(along[1]) == 0.0:
            pupil = regular_pupil(fit, samples)
            if float(along[1]) == 0.0:
                return pupil
            turned = pupil.amplitude.mT, pupil.opd.mT, pupil.cosines.flip(1)
            return replace(pupil, **dict(zip(("amplitude", "opd", "cosines"), turned, strict=True)))
        across = torch.stack((along[1], -along[0]))
        middle, half = 0.5 * (fit.low + fit.high), 0.5 * (fit.high - fit.low)
        step = (torch.arange(samples).to(fit.low) + 0.5) * (2.0 / samples) - 1.0
        reach = torch.stack([half @ along.abs(), half @ across.abs()], -1)
        grid = reach[..., None] * step
        offset = grid[:, 1, :, None, None] * across + grid[:, 0, None, :, None] * along
        unit = (middle[:, None, None] + offset - fit.centre[:, None, None]) / (
            fit.half_width[:, None, None]
        )
        near = unit.norm(dim=-1) <= fit.radius[:, None, None]
        inside = near & (unit.abs() <= 1.0 + 2.0 / samples).all(-1)
        unit = unit.clamp(-1.0, 1.0).flatten(1, 2)
        pieces, degree = [], fit.coefficients.shape[-1] - 1
        for part in unit.split(_PIECE, 1):
            (x, _), (y, _) = (chebyshev(part[..., axis], degree) for axis in (0, 1))
            pieces.append(at_points(fit.coefficients, x, y))
        values = torch.cat(pieces, -1).unflatten(-1, (samples, samples))
        opd, whole, *crossings = values.unbind(1)
        lit = (front.coverage > 0.0).flatten(1).any(-1)[:, None, None]
        passed = (inside & lit).to(opd.dtype)
        surfaces = front.clipping.values()
        for surface, x, y in zip(surfaces, crossings[::2], crossings[1::2], strict=True):
            passed = torch.minimum(passed, coverage(surface.aperture, x, y))
        cell = (2.0 * reach / samples).prod(-1)
        flux = (whole.square() * passed).sum((-2, -1)) * cell
        return RegularPupil(whole * passed, opd, grid, flux, front.wavelength, front.index)


def _unaberrated(pupil: RegularPupil) -> Tensor:
    """Return the irradiance (W,), 1/mm², at the centre of a perfect wavefront's image."""
    cell = (pupil.cosines[..., 1] - pupil.cosines[..., 0]).prod(-1)
    wave = MM_PER_NM * pupil.wavelength / pupil.index
    return (pupil.amplitude.sum((-2, -1)) * cell / wave).square()


# Rows of a pupil that are transformed at a time: they stay in a processor's cache.
_ROWS = 64


def transfer_functions(
    pupil: RegularPupil, axis: int, frequencies: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the optical transfer functions of a pupil along one axis, and those of the same pupil
    without aberrations.

    The transfer function is the pupil's autocorrelation (Goodman, Introduction to Fourier Optics,
    section 6.3).  It comes from the line spread function, whose samples are the squared moduli of
    Fourier transforms of the pupil's rows, summed.  Phases are formed in double precision; the
    transforms are of single precision, and err by 1e-6.

    Args:
        pupil: of W wavelengths and G × G cells.
        axis: of `pupil.cosines`: 0 for the last dimension, 1 for the one before.
        frequencies: (Q,), cycles/mm.

    Returns:
        (W, Q), complex, 1 at zero; and the same without aberrations.
    """
    count = pupil.amplitude.shape[-1]
    size = fast_length(2 * count)
    steps = pupil.cosines[..., 1] - pupil.cosines[..., 0]
    # A cell that passes a share c has amplitude c, but flux c and not c²: the autocorrelation at
    # zero, the mean of its transform, lacks the difference.
    lacking = pupil.flux / steps.prod(-1) - pupil.amplitude.square().sum((-2, -1))
    spread = _line_spreads(pupil, axis, size) + lacking[:, None, None]
    spread = spread / spread.sum(-1, keepdim=True)
    step = steps[:, axis]
    wave = MM_PER_NM * pupil.wavelength / pupil.index
    order = torch.fft.fftfreq(size, dtype=torch.float64, device=spread.device)
    # U(ρ) goes with exp(+ikρα), and the transform with exp(-i…): sample j lies at -j·λ/(n'·Δα).
    place = -(wave / step)[:, None] * order
    phase = -2.0 * torch.pi * frequencies[:, None] * place[:, None]
    found = torch.complex(spread @ phase.cos().mT, spread @ phase.sin().mT)
    # Beyond the autocorrelation's support only its periodic copies are left.
    beyond = (frequencies * wave[:, None]).abs() >= (step * count)[:, None]
    found, perfect = found.masked_fill(beyond[:, None], 0.0).unbind(1)
    return found, perfect


def fast_length(count: int, primes: Sequence[int] = (2, 3, 5, 7, 11), even: bool = False) -> int:
    """Return the smallest number, from a count on, that has no prime factors but these.

    It is SciPy's `next_fast_len`, whose import takes longer than the transforms of a lens.

    Args:
        count: one or more.
        primes: the factors that may be.
        even: whether the number must be even.
    """
    step = 2 if even else 1
    count += count % step
    while True:
        left = count
        for prime in primes:
            while left % prime == 0:
                left //= prime
        if left == 1:
            return count
        count += step


def _line_spreads(pupil: RegularPupil, axis: int, size: int) -> Tensor:
    """Return line spread functions (W, 2, `size`), in the order of a Fourier transform, with and
    without aberrations.
    """
    spreads = []
    for amplitude, opd, wavelength in zip(
        pupil.amplitude, pupil.opd, pupil.wavelength, strict=True
    ):
        aberrated = perfect = amplitude.new_zeros(())
        if axis == 1:
            amplitude, opd = amplitude.mT, opd.mT
        for rows, paths in zip(amplitude.split(_ROWS), opd.split(_ROWS), strict=True):
            turns = paths / (MM_PER_NM * wavelength)
            turns = (2.0 * torch.pi * (turns - turns.round())).float()
            rows = rows.float()
            line = torch.fft.fft(torch.polar(rows, turns), size)
            aberrated = aberrated + (line.real.square() + line.imag.square()).double().sum(0)
            line = torch.fft.rfft(rows, size)
            perfect = perfect + (line.real.square() + line.imag.square()).double().sum(0)
        # The transform of real values is symmetric; only its half is computed.
        other = perfect[1 : (size + 1) // 2].flip(0)
        spreads.append(torch.stack((aberrated, torch.cat([perfect, other]))))
    return torch.stack(spreads)
