"""The image of a bright light with diffraction: a starburst about a stop of blades, a halo about a
round one.

Near the image the field is that of the wavefront (`dolens.diffraction.pixel_psf`), where its
Fourier transform holds and pixels are not wider than its fringes by far; farther out light is what
the pupil's edge diffracts (`dolens.diffraction.edge_diffraction`), of any number of pixels.  Where
there is no wavefront near the image, rays make the image and keep what the edge leaves of them.

A colour stands for the wavelengths as far as half-way to the next one.
"""

import logging
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.diffraction.edge_diffraction import diffracted_light, pupil_edge
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pixel_psf import PixelWindow, propagation, wave_kernels
from dolens.diffraction.pupil_fit import fit_pupil, regular_pupil, with_differentiable_bounds
from dolens.diffraction.wavefront import MM_PER_NM, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.system import OpticalSystem
from dolens.sensor.pixels import Sensor

logger = logging.getLogger(__name__)

# Wavelength over the pupil's width: light is the edge's from so many on, and a wavefront's to so
# many, in windows of at most so many pixels a side, where a pixel is no wider than so many.
_NEAREST, _WINDOW, _WIDEST, _COARSE = 2.0, 4.0, 65, 20.0
# Samples across the pupil, for its flux.
_SAMPLES = 256
# Points where the edge's light lands on a sensor that reaches so many pixels from it, lest streaks
# be grainy at their ends.
_POINTS, _REACH = 1 << 17, 400.0
# Of these, in a cell; and the largest cell, over its distance from the light.
_POINTS_A_CELL, _FINE = 30.0, 0.15
_GOLDEN = 0.6180339887498949
# Wavelengths of a colour near the image, as shares of its band.
_COLOURS = (1.0 / 6.0, 0.5, 5.0 / 6.0)
# Of white: what shows.
GREY_LEVEL = 1.0 / 255.0


class Starburst(NamedTuple):
    """The diffraction of a light of unit power in one colour.

    Attributes:
        rows: (N,), pixels, where the edge's light lands.
        columns: (N,).
        light: (N,).
        cell: (N,), int64, pixels: the side of cells over which each is spread, lest light beside
            streaks be grainy.
        beyond: share of the light among these, which rays do not keep.
        window: (K, K), pixels about the image, which take the place of all else there; None: rays.
        corner: row and column of its first pixel.
    """

    rows: Tensor
    columns: Tensor
    light: Tensor
    cell: Tensor
    beyond: Tensor
    window: Tensor | None
    corner: tuple[int, int]


def bands(wavelengths: Sequence[float]) -> list[tuple[float, float]]:
    """Return the shortest and the longest wavelength (nm) of each colour: half-way to the next, and
    as far beyond the last; a single wavelength is alone.
    """
    order = sorted(set(wavelengths))
    if len(order) == 1:
        return [(w, w) for w in wavelengths]
    middles = [0.5 * (a + b) for a, b in pairwise(order)]
    edges = [2.0 * order[0] - middles[0], *middles, 2.0 * order[-1] - middles[-1]]
    return [(edges[order.index(w)], edges[order.index(w) + 1]) for w in wavelengths]


def starburst(
    system: OpticalSystem,
    sensor: Sensor,
    point: tuple[float, float, float],
    wavelength: float,
    band: tuple[float, float],
    power: float,
) -> Starburst | None:
    """Find the diffraction of an object point's light, where it shows.

    It does not where less than a grey level of it, 1/255 of white, leaves the pixels next to the
    image.  Differentiable in the lens; places of windows are held.

    Args:
        system: the lens, in double precision.
        sensor: the pixels.
        point: x, y and z, mm, z < 0.
        wavelength: nm.
        band: shortest and longest wavelength of the colour, nm.
        power: of the image, in white pixels.

    Returns:
        None where it does not show, where no aperture makes the edge of the pupil, or where the
        wavefront is too steep to be fitted; the log says which.
    """
    points = ObjectPoints.at([point])
    try:
        front = pupil_wavefront(system, points, wavelength)
    except InputError as error:
        logger.info("starburst: left out: %s", error)
        return None
    fit = with_differentiable_bounds(fit_pupil(front))
    flux = regular_pupil(fit, _SAMPLES).flux
    edge = None if bool(front.ended) or not float(flux.detach()) > 0.0 else pupil_edge(fit, flux)
    if edge is None:
        logger.info("starburst: left out: no aperture makes the edge of the pupil")
        return None
    pitch = sensor.pixel_pitch
    share = float(edge.beyond(1.5 * pitch).detach())
    level = power * share / GREY_LEVEL
    if level < 1.0:
        logger.info("starburst: left out: %.2g grey levels leave the pixels at the image", level)
        return None
    fringe = MM_PER_NM * edge.wavelength / edge.width
    row, column = (float(v) for v in sensor.pixels(*front.centre[0]))
    corner = math.hypot(
        max(row, sensor.height - row) + 2.0, max(column, sensor.width - column) + 2.0
    )
    nearest = _NEAREST * fringe
    waves = band[0] / wavelength, band[1] / wavelength
    count = _POINTS << max(0, math.ceil(math.log2(corner / _REACH)))
    farthest = max(corner * pitch, 4.0 * nearest)
    found = diffracted_light(edge, nearest, farthest, count, waves)
    rows, columns = sensor.pixels(*(found.points + front.centre).unbind(-1))
    lit = front.coverage >= 0.5
    spot = float(torch.where(lit, front.intercept.detach().norm(dim=-1), 0.0).amax())
    size = 2 * math.ceil((_WINDOW * fringe + spot) / pitch) + 3
    middle = round(row), round(column)
    colours = [band[0] + c * (band[1] - band[0]) for c in _COLOURS] if band[0] < band[1] else []
    window = None
    if size <= _WIDEST and pitch <= _COARSE * fringe:
        window = _window(system, sensor, point, colours or [wavelength], middle, size)
    whole = found.light.sum() + edge.beyond(corner * pitch)
    logger.info(
        "starburst: %.3g of the light %s is diffracted; near the image %s",
        share,
        "beyond the next pixel",
        f"{size}×{size} pixels by waves" if window is not None else "rays",
    )
    return Starburst(
        rows,
        columns,
        found.light,
        _cells(found.distance / pitch, found.smooth),
        whole,
        None if window is None else window / flux,
        (middle[0] - size // 2, middle[1] - size // 2),
    )


def _cells(distance: Tensor, smooth: Tensor) -> Tensor:
    """Return the side of cells that hold enough of the smooth points, octave by octave of distance.

    Args:
        distance: (N,), pixels.
        smooth: (N,), bool.
    """
    # Octaves fade into each other, so that no edge between cells of two sizes shows.
    step = torch.arange(len(distance), dtype=torch.float64, device=distance.device)
    octave = (distance.log2() + (_GOLDEN * step).frac() - 0.5).floor().long().clamp(min=0)
    count = torch.bincount(octave[smooth], minlength=int(octave.max()) + 1).double()
    # Between r and 2r, of r = 2^octave.
    r = 2.0 ** torch.arange(len(count), dtype=torch.float64, device=distance.device)
    side = (_POINTS_A_CELL * 3.0 * math.pi * r * r / count.clamp(min=1.0)).sqrt()
    cell = 2 ** torch.minimum(side, _FINE * r).clamp(min=1.0).log2().round().long()
    return torch.where(smooth, cell[octave], 1)


def _window(
    system: OpticalSystem,
    sensor: Sensor,
    point: tuple[float, float, float],
    wavelengths: Sequence[float],
    middle: tuple[int, int],
    size: int,
) -> Tensor | None:
    """Return the light of pixels about the image by waves, (size, size); None where these do not
    serve.
    """
    at = torch.tensor([middle], dtype=torch.float64, device=system.device)
    centre = torch.stack(sensor.positions(at[:, 0], at[:, 1]), -1)
    points = ObjectPoints.at([point] * len(wavelengths))
    given = (points, wavelengths, centre.expand(len(wavelengths), 2))
    window = PixelWindow(sensor.pixel_pitch, size)
    try:
        ways = propagation(system, *given, window).reasons
        # Direct integration takes minutes.
        if any(way.startswith("direct") for way in ways):
            return None
        return wave_kernels(system, *given, window).mean(0)
    except InputError:
        return None
