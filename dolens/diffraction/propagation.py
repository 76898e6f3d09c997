"""Light is propagated from the pupil to the sensor: by a Fourier transform where it holds, by
direct integration where not.

With the root A of the flux per area in direction cosines α, the field at ρ from the centre of the
reference sphere is

    U(ρ) = n'/λ · ∫ A(α)·exp(ik·(OPD(α) + n'·(D - R)))·R/D d²α,    k = 2π/λ,

D being the distance from the sphere's point to that of the sensor (Huygens and Fresnel; Born and
Wolf, section 8.2).  |U|² is the flux per area of the sensor.  Where D - R = α·ρ to within a small
part of a wavelength this is a Fourier transform, whose total flux is the pupil's (Parseval).
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.pupil_fit import PupilFit, RegularPupil
from dolens.diffraction.reference_sphere import path_beyond
from dolens.diffraction.wavefront import MM_PER_NM, Wavefront
from dolens.errors import InputError, check_choice
from dolens.optics.autograd import replay

METHODS = ("auto", "fourier", "spectrum", "direct")
# Fewest samples across a pupil, so that its edge is where it belongs, and most.
_FEWEST, MOST_SAMPLES = 96, 2048
# Airy radii around the ray intercepts within which phases must be right.
_AIRY_RADII = 10.0
# Largest difference of the flux through the fitted pupil and of that of the rays, relative.
_FLUX = 0.01
# Largest displacement of the image by the Fourier transform, of its distance from the middle.
_DISTORTION = 0.01
# Every third ray tells how distances bend.
_SOME = 3


@dataclass(frozen=True)
class DiffractionSettings:
    """Settings of a diffraction computation: how finely it is sampled.

    Attributes:
        method: `fourier`, `direct`, or `auto`: Fourier transform where its phases hold; behind a
            diffractive element also `spectrum` (see `dolens.diffraction.free_space`).
        phase_error: waves, the largest error of a phase that the Fourier transform may make.
        rays: along each side of the box of rays that the wavefront is fitted to.
        degree: of the fit; None: 10, or 16 where 10 leaves a hundredth of `phase_error`.
        oversampling: samples of the pupil over those at which copies of the image meet the window.
        samples: across the pupil, G; None: by window, spot, F-number and `oversampling`.
        subsamples: of the irradiance along a pixel; None: by F-number and pitch.
    """

    method: str = "auto"
    phase_error: float = 0.1
    rays: int = 24
    degree: int | None = None
    oversampling: float = 1.5
    samples: int | None = None
    subsamples: int | None = None

    def __post_init__(self) -> None:
        check_choice(self.method, METHODS, "method")
        if not self.phase_error > 0.0 or not self.oversampling >= 1.0:
            raise InputError("phase_error must be positive and oversampling at least 1")
        for name, least in (("samples", 8), ("subsamples", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{name} must be at least {least}, not {value}")


@dataclass(frozen=True)
class Propagation:
    """The choice for N pupils and a window of the sensor, and the errors that it rests on.

    Attributes:
        fourier: (N,), bool: the Fourier transform holds.
        reasons: why, or why not, of each.
        fit_residual: (N,), waves: the largest error of the fitted path difference at a ray.
        sphere_term: (N,), waves: how far the distance from the pupil to a point of the sensor bends
            away from a linear function of the direction cosines, where light goes in the window.
        distortion: (N,), by which part of its distance from the window's middle light is displaced.
        flux_error: (N,), relative difference of fitted and traced flux.
        samples: G, along each side of a pupil that a Fourier transform is of.
    """

    fourier: Tensor
    reasons: tuple[str, ...]
    fit_residual: Tensor
    sphere_term: Tensor
    distortion: Tensor
    flux_error: Tensor
    samples: int = 0


@torch.no_grad()
def choose_propagation(
    fit: PupilFit,
    flux: Tensor,
    half_window: float,
    settings: DiffractionSettings | None = None,
) -> Propagation:
    """Return whether pupils may be propagated by a Fourier transform.

    They may where the fitted path difference, and the distance from the reference sphere taken as
    linear in the direction cosines, are right to `settings.phase_error`, and the image is displaced
    by less than a hundredth of itself; where no part of the pupil's edge is made by rays that miss
    a surface or are totally reflected, which no aperture's margin describes; and where rays and fit
    agree on the flux.

    Args:
        fit: of N pupils.
        flux: (N,), of the pupils that are evaluated from it.
        half_window: mm, from the centre of the reference sphere to the sides of a square window.
        settings: None: the default ones.
    """
    limit = (settings or DiffractionSettings()).phase_error
    wavefront = fit.wavefront
    lit = wavefront.flux > 0.0
    term, distortion = sphere_term(fit, half_window)
    error = torch.where(lit, flux / wavefront.flux - 1.0, 0.0)
    columns = (lit, fit.residual, term, distortion, wavefront.ended, error)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    reasons = []
    for light, residual, bend, moved, ended, excess in rows:
        if not light:
            reasons.append("fourier: no light passes")
            continue
        against = []
        if not residual <= limit:
            against.append(f"the path difference is fitted to {residual:.2g} waves only")
        if not bend <= limit:
            against.append(f"distances to the window bend by {bend:.2g} waves across the pupil")
        if not moved <= _DISTORTION:
            against.append(f"the window's edge is displaced by {moved:.2g} of its distance")
        if ended:
            against.append("rays at the pupil's edge miss a surface or are totally reflected")
        if not abs(excess) <= _FLUX:
            against.append(f"the flux through the fitted pupil errs by {excess:.2g}")
        good = f"fit {residual:.1g} and distances {bend:.1g} waves, at most {limit:g}"
        reasons.append(f"direct: {'; '.join(against)}" if against else f"fourier: {good}")
    return Propagation(
        fourier=torch.tensor([reason.startswith("fourier") for reason in reasons]).to(lit.device),
        reasons=tuple(reasons),
        fit_residual=fit.residual,
        sphere_term=term,
        distortion=distortion,
        flux_error=error,
    )


@torch.no_grad()
def fourier_samples(fit: PupilFit, half_window: float, settings: DiffractionSettings) -> int:
    """G, samples across the widest pupil, that keep copies of the image out of the window.

    Samples Δα apart repeat the image every λ/(n'·Δα), which must be `oversampling` times the
    window's half width and the spot's together.

    Raises:
        InputError: too many.
    """
    if settings.samples is not None:
        return settings.samples
    reach = (_farthest(fit.wavefront) + half_window) / _wave(fit.wavefront)[:, None]
    return _enough(float(((fit.high - fit.low) * reach).amax()) * settings.oversampling)


@torch.no_grad()
def direct_samples(wavefront: Wavefront, half_window: float, settings: DiffractionSettings) -> int:
    """S, rays along each side, so that neighbours' phases differ by less than a turn.

    Raises:
        InputError: too many.
    """
    if settings.samples is not None:
        return settings.samples
    return _enough(turns_across(wavefront, half_window) * settings.oversampling)


@torch.no_grad()
def turns_across(wavefront: Wavefront, half_window: float) -> float:
    """Return how many rays a side make the phases of neighbours differ by one turn at most.

    Args:
        wavefront: of N points.
        half_window: mm, from the centre of the reference sphere to the sides of a square window.
    """
    reach = (wavefront.intercept.abs() + half_window) / _wave(wavefront)[:, None, None, None]
    lit = wavefront.coverage > 0.0
    turns = 0.0
    for dim in (1, 2):
        size = lit.shape[dim] - 1
        step = wavefront.direction.diff(dim=dim).abs() * reach.narrow(dim, 0, size)
        both = lit.narrow(dim, 0, size) & lit.narrow(dim, 1, size)
        turns = max(turns, float(torch.where(both, step.sum(-1), 0.0).amax()))
    return turns * lit.shape[-1]


@torch.no_grad()
def subsamples(fit: PupilFit, pitch: float) -> int:
    """Samples of the irradiance along a pixel, whose sum is then its integral.

    The irradiance has no frequencies beyond f = n'·(pupil's width in direction cosines)/λ.  With
    s samples a pixel its copies begin at s/pitch - f; for s = f·pitch + 2 a quadratic B-spline has
    next to nothing left there.
    """
    return math.ceil(
        float(((fit.high - fit.low) / _wave(fit.wavefront)[:, None]).amax()) * pitch + 2.0
    )


@torch.no_grad()
def sphere_term(fit: PupilFit, half_window: float) -> tuple[Tensor, Tensor]:
    """Return the part of the distance from pupil to sensor that a Fourier transform leaves out.

    D is the distance from the pupil to a point ρ of the sensor.

    About the middle ᾱ of the pupil, D - R = ρ·(α - ᾱ)/s̄ + ... besides what all of it shares, with
    s̄ = D̄/R.  Taking ρ·(α - ᾱ) for it displaces the image by the part 1/s̄ - 1 of its distance from
    the centre, and leaves out -(ρ·(α - ᾱ))²/2R and what follows.

    Args:
        fit: of N pupils.
        half_window: mm; of the window, that part counts where rays land and ten Airy radii around.

    Returns:
        Half the range of what is left out over the pupil, (N,) in waves, and the largest
        |1/s̄ - 1| (N,), at worst of eight points ρ at the sides and corners.
    """
    wavefront, wave = fit.wavefront, _wave(fit.wavefront)
    blur = 1.22 * wave[:, None] / (fit.high - fit.low)
    reach = (_farthest(wavefront) + _AIRY_RADII * blur).clamp(max=half_window)
    some = (slice(None), slice(None, None, _SOME), slice(None, None, _SOME))
    lit, curvature = (wavefront.coverage > 0.0)[some], wavefront.curvature
    middle = 0.5 * (fit.low + fit.high)
    from_middle = wavefront.direction[some] - middle[:, None, None]
    worst, moved = torch.zeros_like(wave), torch.zeros_like(wave)
    for towards in ((1, 0), (0, 1), (1, 1), (1, -1), (-1, 0), (0, -1), (-1, -1), (-1, 1)):
        rho = reach * reach.new_tensor(towards)
        squared, along = rho.square().sum(-1), (middle * rho).sum(-1)
        _, s = path_beyond(along, squared, curvature)
        step = (from_middle * rho[:, None, None]).sum(-1)
        beyond, _ = path_beyond(
            along[:, None, None] + step, squared[:, None, None], curvature[:, None, None]
        )
        bend = beyond - step / s[:, None, None]
        high = torch.where(lit, bend, -torch.inf).amax((1, 2))
        low = torch.where(lit, bend, torch.inf).amin((1, 2))
        worst = torch.maximum(worst, torch.where(high >= low, 0.5 * (high - low), 0.0))
        moved = torch.maximum(moved, (1.0 / s - 1.0).abs())
    return worst / wave, moved


def _wave(wavefront: Wavefront) -> Tensor:
    """(N,), mm: the wavelength before the sensor."""
    return MM_PER_NM * wavefront.wavelength / wavefront.index


def _farthest(wavefront: Wavefront) -> Tensor:
    """(N, 2), mm, of the rays that pass: largest |x| and |y| on the sensor from the centre.

    Rays whose cells pass less than half of their light lie outside the beam.
    """
    share = wavefront.coverage
    lit = (share > 0.0) & (share >= 0.5 * share.amax((1, 2), keepdim=True))
    return torch.where(lit[..., None], wavefront.intercept.abs(), 0.0).amax((1, 2))


class TooSteepError(InputError):
    """A wavefront needs more samples across its pupil than diffraction is computed with."""


def _enough(needed: float) -> int:
    """The next multiple of four, so that small changes of a lens leave it as it is."""
    if not needed <= MOST_SAMPLES:
        raise TooSteepError(
            f"the wavefront is too steep for diffraction: it needs {needed:.0f} samples across the "
            f"pupil, more than {MOST_SAMPLES}; rays alone describe such a spot, or give `samples`"
        )
    return max(_FEWEST, 4 * math.ceil(needed / 4.0))


# Pairs of ray and sensor point at a time in direct integration: some 100 bytes each.
_CHUNK = 1 << 16


def fourier_field(
    pupil: RegularPupil, x: Tensor, y: Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """The field on a regular grid of the sensor, by the matrix Fourier transform.

    U = E_y·P·E_xᵀ with E = exp(ik·n'·ρ·α), for any grids of pupil and sensor (Soummer, Pueyo,
    Sivaramakrishnan and Vanderbei, Opt. Express 15, 15935, 2007).

    Args:
        pupil: of N points.
        x: (X,), mm from the centre of the reference sphere.
        y: (Y,), mm.
        dtype: of the sums.  Phases are formed in double precision and reduced to one turn.

    Returns:
        (N, Y, X), complex; |U|² is flux per mm².  A phase common to all of the pupil and one that
        is linear in ρ are left out.
    """
    wavelength = MM_PER_NM * pupil.wavelength
    centred = pupil.cosines - pupil.cosines.mean(-1, keepdim=True)
    cell = (pupil.cosines[..., 1] - pupil.cosines[..., 0]).prod(-1)
    cycles = (pupil.index / wavelength)[:, None, None] * centred
    along_x, along_y = (
        phasor(rho[:, None].to(cycles) * cycles[:, axis, None], dtype)
        for axis, rho in enumerate((x, y))
    )
    scale = (cell * pupil.index / wavelength)[:, None, None]
    function = phasor(pupil.opd / wavelength[:, None, None], dtype, scale * pupil.amplitude)
    if x.numel() < y.numel():
        return along_y @ (function @ along_x.mT)
    return (along_y @ function) @ along_x.mT


def direct_field(
    wavefront: Wavefront, x: Tensor, y: Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """The field at points of the sensor, by adding up all rays with their exact distances.

    Args:
        wavefront: of N points, with rays enough that neighbours' phases differ by less than half
            a turn (see `direct_samples`).
        x: (M,), mm from the centre of the reference sphere.
        y: (M,), mm.
        dtype: of the sums; phases are in double precision.

    Returns:
        (N, M), complex; |U|² is flux per mm².  A phase common to all rays is left out.
        Memory is bounded, in the gradient too: pieces of the sum are computed again there.
    """
    if x.shape != y.shape or x.ndim != 1:
        raise InputError(f"points are x and y (M,), not {tuple(x.shape)} and {tuple(y.shape)}")
    options: dict[str, Any] = {"dtype": wavefront.opd.dtype, "device": wavefront.opd.device}
    x, y = x.to(**options), y.to(**options)
    fields = [_added(wavefront, n, x, y, dtype) for n in range(len(wavefront.wavelength))]
    return torch.stack(fields)


def _added(wavefront: Wavefront, n: int, x: Tensor, y: Tensor, dtype: torch.dtype) -> Tensor:
    """(M,), complex, of one of the points."""
    lit = wavefront.coverage[n] > 0.0
    wavelength = MM_PER_NM * wavefront.wavelength[n]
    sphere = (wavefront.curvature[n], wavefront.index[n], wavelength)
    weight = wavefront.weight[n][lit] * (wavefront.index[n] / wavelength)
    tensors = (wavefront.direction[n][lit], wavefront.opd[n][lit], weight)
    size = max(1, _CHUNK // max(1, len(weight)))
    parts = list(zip(x.split(size), y.split(size), strict=True))

    def piece(i: int, *rays: Tensor) -> Tensor:
        return wavelets(*parts[i], rays, sphere, dtype).sum(-1)

    return replay(piece, [len(part) for part, _ in parts], tensors)


def wavelets(
    x: Tensor,
    y: Tensor,
    rays: tuple[Tensor, ...],
    sphere: tuple[Tensor, ...],
    dtype: torch.dtype,
) -> Tensor:
    """Return the wavelets of rays at points of the sensor.

    Args:
        x: (M,), mm from the centre of the reference sphere.
        y: (M,), mm.
        rays: directions (R, 2) and OPD (R,), mm, as of `Wavefront`, and weights of the wavelets.
        sphere: its curvature, 1/mm, the index, and the wavelength, mm.
        dtype: of moduli and phases.

    Returns:
        (M, R), complex.
    """
    direction, opd, weight = rays
    curvature, index, wavelength = sphere
    along = torch.stack((x, y), -1) @ direction.mT
    beyond, ratio = path_beyond(along, (x * x + y * y)[:, None], curvature)
    turns = (opd + index * beyond) / wavelength
    return phasor(turns, dtype, weight / ratio)


def phasor(turns: Tensor, dtype: torch.dtype, modulus: Tensor | None = None) -> Tensor:
    """Return modulus·exp(2πi·turns), the phase reduced to one turn before its precision is."""
    phase = (2.0 * torch.pi) * (turns - turns.detach().round()).to(dtype)
    modulus = torch.ones_like(phase) if modulus is None else modulus.to(phase).expand_as(phase)
    return torch.polar(modulus, phase)
