"""Point spread functions with diffraction, as pixels collect them; differentiable in the lens.

The blur of a perfect lens's finite aperture, put behind geometric point spread functions.

The product of the geometric transfer function and the perfect pupil's is right in both limits, of
rays that all meet in a point and of aberrations of many wavelengths.  In between it errs; how much,
a wave calculation tells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.diffraction.element_orders import even_irradiance, light_goes_by_orders, orders_of
from dolens.diffraction.element_waves import ElementLight, element_light
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.propagation import (
    DiffractionSettings,
    Propagation,
    TooSteepError,
    choose_propagation,
    direct_field,
    direct_samples,
    fourier_field,
    fourier_samples,
    subsamples,
)
from dolens.diffraction.pupil_fit import (
    PupilFit,
    RegularPupil,
    fit_pupil,
    regular_pupil,
    with_differentiable_bounds,
)
from dolens.diffraction.reference_sphere import chief_ray_intercepts
from dolens.diffraction.wavefront import Wavefront, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.autograd import replay
from dolens.optics.ray_tracing import say_once
from dolens.optics.system import OpticalSystem


@dataclass(frozen=True)
class PixelWindow:
    """A square window of pixels about a point of the sensor.

    Attributes:
        pitch: of the pixels, mm.
        size: pixels along each side.

    Raises:
        InputError: a pitch that is not positive, or no pixel.
    """

    pitch: float
    size: int

    def __post_init__(self) -> None:
        if not self.pitch > 0.0 or self.size < 1:
            raise InputError(
                f"pitch must be positive and size at least 1, not {self.pitch} and {self.size}"
            )

    @property
    def half_width(self) -> float:
        """mm, of what `fine_grid` covers."""
        return self.pitch * (0.5 * self.size + 1.0)


def quadratic_b_spline(u: Tensor) -> Tensor:
    """β(u): a unit box convolved with itself twice; 3/4 - u² near zero, zero from |u| = 3/2 on."""
    u = u.abs()
    return torch.where(u < 0.5, 0.75 - u * u, 0.5 * (1.5 - u).clamp(min=0.0).square())


def fine_grid(size: int, subsamples: int, like: Tensor) -> Tensor:
    """Return the samples along a window of pixels: centres of cells, in pixels from its middle.

    Args:
        size: pixels along a side.
        subsamples: cells a pixel.
        like: gives precision and device.

    Returns:
        (subsamples·(size + 2),), ascending; β reaches a pixel beyond the window.
    """
    count = subsamples * (size + 2)
    cells = torch.arange(count, dtype=like.dtype, device=like.device)
    return (cells + 0.5) / subsamples - 0.5 * (size + 2)


def pixel_matrix(size: int, subsamples: int, like: Tensor) -> Tensor:
    """β(x/p - i) of every pixel i at the samples x of `fine_grid`.

    β is a pixel's box convolved with a texel's tent, as in `dolens.rendering.psf`.  With B this
    matrix times the samples' distance, B·I·Bᵀ is what pixels collect of the irradiance I: exactly,
    where I has no frequency that a multiple of the samples' own takes to where β has one.

    Args:
        size: pixels along a side.
        subsamples: samples a pixel.
        like: gives precision and device.

    Returns:
        (size, subsamples·(size + 2)).  The pixels' shares of a sample add up to one within the
        window.
    """
    pixel = torch.arange(size, dtype=like.dtype, device=like.device) - 0.5 * (size - 1)
    return quadratic_b_spline(fine_grid(size, subsamples, like) - pixel[:, None])


Points = ObjectPoints | Tensor | Sequence[Sequence[float]]
Centres = Tensor | Sequence[Sequence[float]] | None
Wavelengths = float | Sequence[float] | Tensor

# Degrees of the fit that are tried, and the share of the phase error that the first may leave.
_DEGREES, _SHARE = (10, 16), 0.01
# Numbers of a piece of work; more pupils than fit are done in pieces, and again for the gradient.
_PIECE = 1 << 24
# Functions that are evaluated for a pupil: path difference, amplitude, what passes, and crossings.
_FUNCTIONS = 8
# Steps along a radius in a period of the irradiance's finest detail.
_RADIAL_STEPS = 4.0


def wave_kernels(
    system: OpticalSystem,
    points: Points,
    wavelength: Wavelengths,
    centres: Centres,
    window: PixelWindow,
    settings: DiffractionSettings | None = None,
) -> Tensor:
    """Compute what pixels collect of object points' light, with diffraction.

    Each kernel is the irradiance convolved with a quadratic B-spline, a pixel's box by a texel's
    tent, as in `axial_point_spread_functions`: the discrete convolution of a texture with it is the
    image, wherever the field is small enough for one kernel.

    Behind a diffractive element light goes as `dolens.diffraction.element_waves` says, and from one
    between lenses as `element_orders` does.

    Where the Fourier transform does not hold, the integral is done directly, which takes a thousand
    times as long; the log says so and why, and so does `propagation`.

    Args:
        system: `lens.system(values)`.
        points: N object points, or their positions (N, 3) in mm in the lens's axes (z < 0).
        wavelength: nm, one or N.
        centres: (N, 2), mm on the sensor, of the windows; None: where the chief rays land.
        window: its pitch and size are those of all windows.
        settings: how finely; None: the default.

    Returns:
        (N, size, size), in the lens's precision, upright as in `Sensor`: the point (x, y) from the
        centre is at column (size - 1)/2 - x/pitch and row (size - 1)/2 + y/pitch.  The sum over an
        infinite window is the flux that passes, over that of the axial point of the same object
        plane through the paraxial entrance pupil; zero where none passes.  Differentiable in the
        lens, the movement of the pupil's edges included; windows are held constant.

    Raises:
        InputError: numbers that do not fit, or a wavefront too steep for diffraction.
    """
    settings = settings or DiffractionSettings()
    if system.diffractive:
        points = _object_points(points)
        if light_goes_by_orders(system):
            return _by_orders(system, points, wavelength, centres, window, settings)
        light = element_light(system, points, wavelength, centres, settings)
        axial = (points.slopes == 0.0).all(-1).tolist()
        return _by_element(light, window, system.dtype, axial)
    if settings.method == "spectrum":
        raise InputError("method spectrum is that of a lens with a diffractive element")
    found = _prepare(system, points, wavelength, centres, window, settings)
    cells = settings.subsamples or subsamples(found.fit, window.pitch)
    pixels = _Subpixels(window, cells, system.dtype)
    fourier = found.chosen.fourier
    if settings.method != "auto":
        fourier = torch.full_like(fourier, settings.method == "fourier")
    if bool(fourier.all()):
        return _by_fourier(found, pixels)
    which = torch.nonzero(~fourier).flatten()
    if settings.method == "auto":
        for n in which.tolist():
            say_once(f"diffraction: {found.chosen.reasons[n]}")
    front = found.fit.wavefront
    rays = pupil_wavefront(
        system,
        found.points[which],
        front.wavelength[which],
        front.centre[which],
        direct_samples(front, window.half_width, settings),
        1.0 / front.curvature[which],
    )
    direct = _by_integration(rays, pixels)
    if len(which) == len(found.points):
        return direct
    return _by_fourier(found, pixels).index_copy(0, which, direct)


@torch.no_grad()
def propagation(
    system: OpticalSystem,
    points: Points,
    wavelength: Wavelengths,
    centres: Centres,
    window: PixelWindow,
    settings: DiffractionSettings | None = None,
) -> Propagation:
    """Say how `wave_kernels` of the same arguments propagates light by itself, and why."""
    settings = settings or DiffractionSettings()
    if system.diffractive and light_goes_by_orders(system):
        places = _object_points(points).to(torch.float64, system.device)
        waves = torch.as_tensor(wavelength).to(places.slopes).expand(len(places))
        system = orders_of(system.double(), places, waves)[0].system
    if system.diffractive:
        light = element_light(system, _object_points(points), wavelength, centres, settings)
        return _element_propagation(light, window)
    return _prepare(system, points, wavelength, centres, window, settings).chosen


def _object_points(points: Points) -> ObjectPoints:
    return points if isinstance(points, ObjectPoints) else ObjectPoints.at(points)


def _element_propagation(light: ElementLight, window: PixelWindow) -> Propagation:
    plans = [light.plan(n, window.half_width) for n in range(len(light))]
    none = torch.zeros_like(light.fit.residual)
    return Propagation(
        fourier=torch.tensor([plan.method == "fourier" for plan in plans]),
        reasons=tuple(plan.reason for plan in plans),
        fit_residual=light.fit.residual,
        sphere_term=none,
        distortion=none,
        flux_error=none,
        samples=max(plan.count for plan in plans),
    )


def _by_element(
    light: ElementLight, window: PixelWindow, dtype: torch.dtype, axial: Sequence[bool]
) -> Tensor:
    """Return kernels (N, size, size) of light behind a diffractive element, a point at a time.

    One radius says all about points on the axis of a round lens, where no method is asked for.
    """
    half = window.half_width
    plans = [light.plan(n, half) for n in range(len(light))]
    chosen = light.settings.method == "auto"
    radial = [chosen and on and light.one_radius(n, half) for n, on in enumerate(axial)]

    def kernel(i: int, *tensors: Tensor) -> Tensor:
        plan = plans[i]
        count = light.settings.subsamples or math.ceil(plan.band * window.pitch + 2.0)
        pixels = _Subpixels(window, count, dtype)
        x, y = pixels.grid(light.centre)
        light_now = light.with_tensors(tensors)
        if radial[i]:
            step = 1.0 / (_RADIAL_STEPS * plan.band)
            rho = torch.arange(math.ceil(math.sqrt(2.0) * half / step) + 3).to(x) * step
            place = torch.hypot(x[None], y[:, None]) / step
            along = light_now.radial(i, plan, rho, dtype)
            # A parabola through the three nearest.
            near = place.round().clamp(min=1.0)
            at, off = near.long(), (place - near).to(along)
            before, there, after = (along[at + k] for k in (-1, 0, 1))
            bend = 0.5 * off * off * (after - 2.0 * there + before)
            return pixels.collected(there + 0.5 * off * (after - before) + bend)[..., None]
        return pixels.collected(light_now.irradiance(i, plan, x, y, dtype))[..., None]

    return replay(kernel, [1] * len(plans), light.tensors).movedim(-1, 0)


def _by_orders(
    system: OpticalSystem,
    points: ObjectPoints,
    wavelength: Wavelengths,
    centres: Centres,
    window: PixelWindow,
    settings: DiffractionSettings,
) -> Tensor:
    """Return kernels (N, size, size) of all orders of a lens's diffractive elements."""
    system, dtype = system.double(), system.dtype
    points = points.to(torch.float64, system.device)
    waves = torch.as_tensor(wavelength).to(points.slopes).expand(len(points))
    if centres is None:
        centres = chief_ray_intercepts(system, points, waves)
    centre = torch.as_tensor(centres).to(points.slopes)
    total = torch.zeros((len(points), window.size, window.size)).to(points.slopes)
    for place, order in enumerate(orders_of(system, points, waves)):
        light, even = even_irradiance(order, points, waves, centre, window.half_width)
        sharp = (~even).nonzero().flatten()
        if place and len(sharp):
            # Direct integration takes too long for some per cent of the light.
            sharp = sharp[_by_transform(order.system, points, waves, centre, sharp, window)]
        even = torch.ones_like(even).index_fill(0, sharp, False)
        total = total + (torch.where(even, light, 0.0) * window.pitch**2)[:, None, None]
        if len(sharp):
            kernels = wave_kernels(
                order.system, points[sharp], waves[sharp], centre[sharp], window, settings
            )
            total = total.index_add(0, sharp, order.share[sharp, None, None] * kernels)
    return total.to(dtype)


def _by_transform(
    system: OpticalSystem,
    points: ObjectPoints,
    waves: Tensor,
    centre: Tensor,
    which: Tensor,
    window: PixelWindow,
) -> Tensor:
    """Return whether a Fourier transform holds for some of the points (K,), bool."""
    try:
        return propagation(system, points[which], waves[which], centre[which], window).fourier
    except TooSteepError:
        return torch.zeros_like(which, dtype=torch.bool)


@dataclass(frozen=True)
class _Prepared:
    points: ObjectPoints
    fit: PupilFit
    samples: int
    chosen: Propagation
    # Of all pupils, where they are one piece of work.
    pupil: RegularPupil | None = None

    def pieces(self, beside: int) -> Sequence[Tensor]:
        """Numbers of the pupils, as many at a time as memory is meant for, beside a window."""
        return _pieces(self.fit, self.samples, beside)


def _pieces(fit: PupilFit, samples: int, beside: int = 0) -> Sequence[Tensor]:
    size = _FUNCTIONS * samples**2 + (samples + beside) ** 2
    return torch.arange(len(fit.low)).split(max(1, _PIECE // size))


@dataclass(frozen=True)
class _Subpixels:
    window: PixelWindow
    count: int
    dtype: torch.dtype

    def grid(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """x and y (mm) of the irradiance's columns and rows, ordered as pixels are stored."""
        fine = self.window.pitch * fine_grid(self.window.size, self.count, like)
        return -fine, fine

    def integrated(self, field: Tensor) -> Tensor:
        """(N, size, size): the flux of |field|² in every pixel."""
        return self.collected(field.real.square() + field.imag.square())

    def collected(self, irradiance: Tensor) -> Tensor:
        """(N, size, size): the flux of an irradiance in every pixel."""
        step = self.window.pitch / self.count
        matrix = step * pixel_matrix(self.window.size, self.count, irradiance)
        return matrix @ irradiance @ matrix.mT


def _prepare(
    system: OpticalSystem,
    points: Points,
    wavelength: Wavelengths,
    centres: Centres,
    window: PixelWindow,
    settings: DiffractionSettings,
) -> _Prepared:
    points = _object_points(points)
    rays = pupil_wavefront(system, points, wavelength, centres, settings.rays)
    fit = with_differentiable_bounds(_fitted(rays, settings))
    points = points.to(rays.opd.dtype, rays.opd.device)
    samples = fourier_samples(fit, window.half_width, settings)
    parts = _pieces(fit, samples)
    pupil = regular_pupil(fit, samples) if len(parts) == 1 else None
    if pupil is not None:
        flux = pupil.flux
    else:
        with torch.no_grad():
            flux = torch.cat([regular_pupil(fit, samples, part).flux for part in parts])
    chosen = choose_propagation(fit, flux, window.half_width, settings)
    return _Prepared(points, fit, samples, replace(chosen, samples=samples), pupil)


def _fitted(wavefront: Wavefront, settings: DiffractionSettings) -> PupilFit:
    if settings.degree is not None:
        return fit_pupil(wavefront, settings.degree)
    fit = fit_pupil(wavefront, _DEGREES[0])
    if bool((fit.residual <= _SHARE * settings.phase_error).all()):
        return fit
    return fit_pupil(wavefront, _DEGREES[1])


def _by_fourier(found: _Prepared, pixels: _Subpixels) -> Tensor:
    x, y = pixels.grid(found.fit.low)
    parts = found.pieces(len(x))

    def kernels(pupil: RegularPupil) -> Tensor:
        return pixels.integrated(fourier_field(pupil, x, y, pixels.dtype))

    if found.pupil is not None and len(parts) == 1:
        return kernels(found.pupil)

    clipping = found.fit.wavefront.clipping
    moving = {n: surface.edge for n, surface in clipping.items() if surface.edge is not None}

    def piece(i: int, coefficients: Tensor, low: Tensor, high: Tensor, *edges: Tensor) -> Tensor:
        moved = {n: replace(clipping[n], edge=e) for n, e in zip(moving, edges, strict=True)}
        wavefront = replace(found.fit.wavefront, clipping={**clipping, **moved})
        fit = replace(found.fit, coefficients=coefficients, low=low, high=high, wavefront=wavefront)
        return kernels(regular_pupil(fit, found.samples, parts[i])).movedim(0, -1)

    fit = found.fit
    tensors = (fit.coefficients, fit.low, fit.high, *moving.values())
    return replay(piece, [len(part) for part in parts], tensors).movedim(-1, 0)


def _by_integration(wavefront: Wavefront, pixels: _Subpixels) -> Tensor:
    x, y = pixels.grid(wavefront.opd)
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    field = direct_field(wavefront, columns.flatten(), rows.flatten(), pixels.dtype)
    return pixels.integrated(field.unflatten(-1, (len(y), len(x))))


def diffraction_transfer(
    height: int, width: int, pitch: float, wavelength: float, f_number: float | Tensor
) -> Tensor:
    """The incoherent transfer function of a perfect, round pupil.

    (2/π)·(arccos s - s·√(1 - s²)), with s the frequency over 1/(λN), and zero beyond it (Goodman,
    Introduction to Fourier Optics).

    Args:
        height: of the transform.
        width: of the transform.
        pitch: of the pixels, mm.
        wavelength: nm.
        f_number: N, that the light works with: 1/(2·sin u').

    Returns:
        (height, width/2 + 1), float64, at the frequencies of `rfft2`; differentiable in N once.
    """
    device = f_number.device if isinstance(f_number, Tensor) else torch.device("cpu")
    down = torch.fft.fftfreq(height, dtype=torch.float64, device=device)
    across = torch.fft.rfftfreq(width, dtype=torch.float64, device=device)
    cutoff = pitch / (wavelength * 1e-6 * f_number)
    moved = torch.hypot(down[:, None], across[None]) / cutoff
    s = moved.detach().clamp(max=1.0)
    root = (1.0 - s * s).sqrt()
    found = (torch.arccos(s) - s * root) * (2.0 / math.pi)
    # The slope, -(4/π)·√(1 - s²), is zero at the cutoff, where arccos's own is infinite.
    return found - (4.0 / math.pi) * root * (moved - moved.detach())


def with_diffraction_limit(
    functions: Tensor, pitch: float, wavelengths: Sequence[float], f_number: float | Tensor
) -> Tensor:
    """Functions (..., C, K, K) blurred by the perfect pupil's diffraction at C wavelengths.

    What this spreads beyond the window, 2λN/(π²r) of the light beyond radius r, is given back in
    proportion, so that each function keeps its sum.
    """
    size = functions.shape[-1]
    # As wide as the Airy disc's share beyond it is small, lest its other side come back in.
    side = max(2 * size, 128)
    transfer = torch.stack(
        [diffraction_transfer(side, side, pitch, w, f_number) for w in wavelengths]
    ).to(functions)
    spectrum = torch.fft.rfft2(functions, s=(side, side)) * transfer
    blurred = torch.fft.irfft2(spectrum, s=(side, side))[..., :size, :size]
    kept = blurred.sum((-2, -1), keepdim=True)
    total = functions.sum((-2, -1), keepdim=True)
    return blurred * torch.where(kept > 0.0, total / torch.where(kept > 0.0, kept, 1.0), 0.0)
