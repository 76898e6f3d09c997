"""Point spread functions of many cameras, which a restorer for any lens is trained with."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.zernike_fit import zernike_polynomials, zernike_terms
from dolens.diffraction.pupil_fit import RegularPupil, regular_pupil
from dolens.diffraction.wavefront import MM_PER_NM
from dolens.errors import InputError
from dolens.experiments.pretraining.pixel_functions import pixel_functions, pupil_rays
from dolens.experiments.pretraining.random_pupils import (
    COARSE,
    GREEN,
    Aperture,
    Draw,
    FormulaOptics,
    Prescriptions,
    longitudinal_colour,
)

# Shares of the bank by source.
SOURCES = {"lens": 0.35, "phase plate": 0.25, "wavefront": 0.2, "defocus": 0.1, "sharp": 0.1}

SIZE = 65
_HELD = 0.97
# Spot radii (pixels, root mean square), pixel pitches (mm), and F-numbers that are drawn.
_SPOTS, _PITCHES, _F_NUMBERS = (0.3, 8.0), (1.5e-3, 10e-3), (1.4, 11.0)
# Pixels (mm) of a spot that is given in waves may be larger.
_LIMITS = (1e-3, 40e-3)
# Waves that a lens's wavefront may differ from its fit.
_RESIDUAL = 0.25
# Root mean square distance of a function's light from the window's centre, pixels, at most.
_FARTHEST = 14.0
# Of the lens's focal length, mm, as it is scaled.
_FOCAL_LENGTHS = (2.0, 300.0)


class Camera(NamedTuple):
    """A camera's point spread functions.

    Attributes:
        functions: (D, 3, K, K), of unit sum, at D = 3 depths and the colours red, green and blue.
        name: what they come from.
    """

    functions: Tensor
    name: str


PupilAt = Callable[[int], RegularPupil]


def cameras(count: int, generator: torch.Generator) -> Iterator[Camera]:
    """Yield cameras whose sources have the shares of `SOURCES`, in random order.

    Args:
        count: of cameras.
        generator: on the CPU; the same state gives the same cameras.

    Raises:
        InputError: a count that is not positive.
    """
    if count < 1:
        raise InputError(f"count: {count}; allowed: at least 1 camera")
    draw = Draw(generator)
    lenses = Prescriptions()
    makers: dict[str, Callable[[Draw], Camera | None]] = {
        "lens": lambda draw: _of_a_lens(lenses, draw),
        "phase plate": phase_plate,
        "wavefront": random_wavefront,
        "defocus": defocused,
        "sharp": sharp,
    }
    names, shares = list(SOURCES), torch.tensor(list(SOURCES.values()))
    made = 0
    while made < count:
        source = names[int(torch.multinomial(shares, 1, generator=generator))]
        camera = None
        while camera is None:
            camera = makers[source](draw)
        made += 1
        yield camera


def function_bank(count: int, generator: torch.Generator) -> tuple[Tensor, list[str]]:
    """Return the functions of `cameras` together, (count, 3, 3, K, K) in half precision, and the
    cameras' names; some 0.1 s of a core and 76 kB each.

    Raises:
        InputError: as `cameras`.
    """
    drawn = [(c.functions.half(), c.name) for c in cameras(count, generator)]
    functions, names = zip(*drawn, strict=True)
    return torch.stack(functions), list(names)


def _of_a_lens(lenses: Prescriptions, draw: Draw) -> Camera | None:
    """Scale and focus a lens so that its spots have the radius that is drawn."""
    traced = lenses.traced(draw)
    if traced is None:
        return None
    fit, length = traced.fit, traced.focal_length
    coarse = regular_pupil(fit, COARSE)
    variance, along, slope = (m.unflatten(0, (3, 2)).mean(1) for m in pupil_rays(coarse).moments())
    # Sharpest green; the mean of the colours is then what it is.
    sharpest = -float(along[1] / slope[1])
    least = float((variance + 2.0 * sharpest * along + sharpest**2 * slope).mean())
    least = math.sqrt(max(least, 1e-16))
    pitch = draw.log_uniform(*_PITCHES)
    wanted = pitch * draw.log_uniform(*_SPOTS)
    # Part of it is aberration, the rest defocus.
    part = math.sqrt(draw.uniform(0.05, 1.0))
    scale = part * wanted / least
    scale = min(max(scale, _FOCAL_LENGTHS[0] / length), _FOCAL_LENGTHS[1] / length)
    if float(fit.residual.amax()) * scale > _RESIDUAL:
        return None
    rest = math.sqrt(max(wanted**2 - (scale * least) ** 2, 0.0))
    blur_of_shift = math.sqrt(float(slope.mean()))
    middle = scale * sharpest + draw.sign() * rest / blur_of_shift
    spot = max(wanted, scale * least)

    def at(samples: int) -> RegularPupil:
        pupil = regular_pupil(fit, samples)
        return replace(pupil, opd=scale * pupil.opd)

    shifts = _depths(middle, spot, pitch, blur_of_shift, draw)
    return _on_pixels(at, shifts, pitch, traced.name, draw)


def _depths(middle: float, spot: float, pitch: float, blur: float, draw: Draw) -> list[float]:
    """Return three focus shifts (mm): equal ones for a fixed depth, else spread about the middle.

    Args:
        middle: mm.
        spot: mm, its radius there.
        pitch: mm.
        blur: mm of spot radius for a shift of 1 mm.
    """
    if draw.chance(0.25):
        return [middle] * 3
    most = min(4.0 * pitch, 1.5 * max(spot, 0.7 * pitch))
    step = draw.sign() * draw.log_uniform(0.1 * pitch, max(most, 0.2 * pitch)) / blur
    return [middle + share * step for share in (-1.0, 0.0, 1.0)]


def _on_pixels(
    at: PupilAt, shifts: Sequence[float], pitch: float, what: str, draw: Draw
) -> Camera | None:
    """Return the functions of a camera, with coarser pixels where a window holds too little."""
    turned = draw.chance(0.5)
    for _ in range(8):
        functions, held = pixel_functions(at, shifts, pitch, SIZE)
        if held >= _HELD:
            break
        pitch *= 1.3
    else:
        return None
    # The two wavelengths of a band count alike.
    functions = functions.unflatten(1, (3, -1)).mean(2)
    square = (torch.arange(SIZE) - SIZE // 2).square().to(functions)
    distance = (functions * (square[:, None] + square)).sum((-2, -1))
    if not bool((distance <= _FARTHEST**2).all()):
        return None
    if turned:
        functions = functions.flip(-1)
    return Camera(functions, f"{what}, {1e3 * pitch:.2g} µm pixels")


def phase_plate(draw: Draw) -> Camera | None:
    """Draw a camera with a cubic phase plate, or one of higher order, over a range of depths."""
    strength = draw.log_uniform(1.0, 40.0)
    cross = 0.0 if draw.chance(0.4) else draw.uniform(-1.0, 1.0)
    fifth = draw.uniform(-0.6, 0.6) if draw.chance(0.25) else 0.0
    uneven = draw.uniform(0.7, 1.3) if draw.chance(0.3) else 1.0
    signs = draw.sign(), draw.sign()
    turn = draw.uniform(0.0, 2.0 * math.pi) if draw.chance(0.3) else 0.0
    spherical = draw.uniform(-0.5, 0.5)
    colour = longitudinal_colour(draw)
    # n - 1 of a plate falls by a few per cent from blue to red.
    dispersion = draw.uniform(0.005, 0.02)

    def shape(x: Tensor, y: Tensor) -> Tensor:
        u = signs[0] * (math.cos(turn) * x + math.sin(turn) * y)
        v = signs[1] * (math.cos(turn) * y - math.sin(turn) * x)
        plate = u**3 + uneven * v**3 + cross * u * v * (u + v)
        plate = plate + fifth * (u**5 + v**5)
        return GREEN * (strength * plate + spherical * (x * x + y * y) ** 2)

    f_number = draw.log_uniform(*_F_NUMBERS)
    optics = FormulaOptics(f_number, draw.bands(), shape, colour, dispersion=dispersion)
    middle = optics.shift_of(draw.uniform(-2.0, 2.0))
    half = optics.shift_of(draw.uniform(0.0, 6.0) * draw.sign())
    shifts = [middle - half, middle, middle + half]
    spots = draw.log_uniform(0.8, _SPOTS[1])
    what = f"cubic plate of {strength:.3g} waves at F/{optics.f_number:.2g}"
    return _with_spot(optics, shifts, spots, what, draw)


def random_wavefront(draw: Draw) -> Camera | None:
    """Draw a camera with random Zernike terms, colour and a pupil of any outline."""
    terms = zernike_terms("standard", 28)[3:]
    order = torch.tensor([float(term.n) for term in terms], dtype=torch.float64)
    found = draw.normal(len(terms)) * order ** -draw.uniform(0.5, 3.0)
    # Some are of few terms, as a lens's are.
    if draw.chance(0.5):
        kept = torch.rand(len(terms), generator=draw.generator) < 0.25
        found = torch.where(kept, found, 0.0)
    size = float(found.norm())
    rms = draw.log_uniform(0.03, 3.0)
    found = found * (rms / size if size > 0.0 else 0.0)
    colour = longitudinal_colour(draw)

    def shape(x: Tensor, y: Tensor) -> Tensor:
        zernike = zernike_polynomials(x.flatten(), y.flatten(), terms)
        return GREEN * (found @ zernike).unflatten(0, x.shape)

    f_number = draw.log_uniform(*_F_NUMBERS)
    optics = FormulaOptics(f_number, draw.bands(), shape, colour, Aperture.drawn(draw))
    middle = optics.shift_of(draw.log_uniform(0.02, 3.0) * draw.sign())
    half = 0.0 if draw.chance(0.25) else optics.shift_of(draw.log_uniform(0.05, 3.0) * draw.sign())
    shifts = [middle - half, middle, middle + half]
    what = f"wavefront of {rms:.2g} waves RMS at F/{optics.f_number:.2g}"
    return _with_spot(optics, shifts, draw.log_uniform(*_SPOTS), what, draw)


def defocused(draw: Draw) -> Camera | None:
    """Draw a camera with an ideal lens out of focus."""
    f_number, colour = draw.log_uniform(*_F_NUMBERS), longitudinal_colour(draw)
    optics = FormulaOptics(f_number, draw.bands(), _flat, colour, Aperture.drawn(draw))
    pitch, spot = draw.log_uniform(*_PITCHES), draw.log_uniform(*_SPOTS)
    blur = optics.blur()[2]
    middle = draw.sign() * spot * pitch / blur
    shifts = _depths(middle, spot * pitch, pitch, blur, draw)
    return _on_pixels(optics.at, shifts, pitch, f"defocus at F/{optics.f_number:.2g}", draw)


def sharp(draw: Draw) -> Camera | None:
    """Draw a camera that is sharp to a fraction of a pixel, or limited by diffraction."""
    f_number = draw.log_uniform(*_F_NUMBERS)
    optics = FormulaOptics(f_number, draw.bands(), _flat, lambda wave: 0.0, Aperture.drawn(draw))
    # The Airy disc is two pixels wide at most.
    pitch = max(draw.log_uniform(*_PITCHES), 1.22 * GREEN * MM_PER_NM * optics.f_number)
    blur = optics.blur()[2]
    shifts = [draw.uniform(-0.3, 0.3) * pitch / blur for _ in range(3)]
    if draw.chance(0.5):
        shifts = shifts[:1] * 3
    return _on_pixels(optics.at, shifts, pitch, f"sharp at F/{optics.f_number:.2g}", draw)


def _flat(x: Tensor, y: Tensor) -> Tensor:
    return torch.zeros_like(x)


def _with_spot(
    optics: FormulaOptics, shifts: Sequence[float], spot: float, what: str, draw: Draw
) -> Camera | None:
    """Choose the pixels so that the mean square spot of all depths has so many pixels' radius."""
    variance, along, blur = optics.blur()
    squares = [variance + 2.0 * shift * along + (shift * blur) ** 2 for shift in shifts]
    # A sharp spot is as large as the Airy disc's half.
    airy = 0.61 * GREEN * MM_PER_NM * optics.f_number
    pitch = max(math.sqrt(max(sum(squares) / len(squares), 0.0)), airy) / spot
    pitch = min(max(pitch, _LIMITS[0]), _LIMITS[1])
    return _on_pixels(optics.at, shifts, pitch, what, draw)
