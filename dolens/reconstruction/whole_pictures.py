"""Pictures of any size are restored in overlapping windows, by functions of each place.

A window is restored by the point spread functions of its middle.  Where windows overlap, one fades
into the other along a raised cosine, so that no seam shows.  Around what is kept of a window the
restorer sees a margin, so that the window's end has no influence on it; beyond the picture's edges
it sees the mirror image.  Memory is that of a window, but for the picture itself.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.photograph_page.page import ShownPhotograph
from dolens.reconstruction.general import GeneralRestoration
from dolens.reconstruction.quality import psnr_db
from dolens.rendering.photograph import Photograph
from dolens.sensor.display import Picture
from dolens.sensor.readout import Readout

# Pixels along which windows fade into each other, and beyond them that a restorer sees besides half
# of the point spread functions.
_OVERLAP, _MARGIN = 32, 16
# Relative illumination that is made up for, at least.
_DARKEST = 0.05

# Rows (N,) and columns (N,), pixels, to point spread functions (N, D, 3, K, K).
Functions = Callable[[Tensor, Tensor], Tensor]
# Of a window (1, 3, H, W), linear light, functions (D, 3, K, K), no field, and noise (2,): the
# picture (1, 3, H, W).  A `Restoration` is one.
Restorer = Callable[[Tensor, Tensor, None, Tensor], Tensor]
# Rows (H,) and columns (W,), pixels, to relative illumination (3, H, W).
Illumination = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False, repr=False)
class RestoredPicture(Picture):
    """A `RestoredPicture` is made of a photograph; it shows itself in a notebook.

    Attributes:
        sensor: the sensor's image that it was restored from, (3, H, W), sRGB values from 0 to 1.
    """

    sensor: Tensor

    def shown(self, name: str) -> ShownPhotograph:
        """Return it as a page has it, by a name, beside truth and sensor image, with their PSNR."""
        pictures = {"truth": self.truth, "sensor": self.sensor, "restored": self.image}
        scores = {
            f"{label} PSNR, dB": float(psnr_db(image[None], self.truth[None]))
            for label, image in pictures.items()
            if image is not self.truth
        }
        return ShownPhotograph(name, pictures, scores)


def restore(
    photograph: Photograph, restorer: Restorer | None = None, window: int | None = None
) -> RestoredPicture:
    """Restore a photograph by a network that is told the point spread functions and the noise.

    Nothing is trained: one network that comes with dolens restores for any lens, see
    `GeneralRestoration`.  Distortion stays, as in the photograph's truth.

    512×512 pixels take half a second to two seconds of one core, and larger photographs longer in
    proportion; of D distances, D + 1 times as long.

    >>> import torch
    >>> grey = torch.full((3, 48, 64), 0.5)  # sRGB; a path will do
    >>> photo = dolens.load_lens("cooke_triplet").photograph(grey)
    >>> restored = dolens.restore(photo)
    >>> restored
    RestoredPicture of 64×48 pixels
    >>> error = dolens.reconstruction.mean_squared_error
    >>> bool(error(restored.image, restored.truth) < error(photo.image, photo.truth) / 100)
    True

    Args:
        photograph: as `lens.photograph` gives it.

    Rarely needed:
        restorer: another one that is told both, as `WienerTVRestoration()`.
        window: pixels along each side of what is restored by one function, 32 or more; None: what
            its change over the field allows.

    Returns:
        `image` and `truth` (3, H, W), sRGB from 0 to 1; `save(path)`, of which a path that ends in
        .html is a page with a slider between truth, sensor image and it; it shows itself in a
        notebook.

    Raises:
        InputError: no photograph, or a window of fewer than 32 pixels.
    """
    if not isinstance(photograph, Photograph):
        raise InputError(
            f"photograph: of type {type(photograph).__name__}; allowed: what lens.photograph gives"
        )
    found = restore_whole_picture(
        _shipped(photograph.signal.device) if restorer is None else restorer,
        photograph.signal,
        photograph.camera.readout,
        photograph.point_spread_functions,
        photograph.illumination,
        photograph.camera.field.window() if window is None else window,
    )
    return RestoredPicture(found.clamp_(0.0, 1.0), photograph.truth, photograph.image)


@cache
def _shipped(device: torch.device) -> GeneralRestoration:
    return GeneralRestoration(by_depth=True).eval().to(device)


class Stretch(NamedTuple):
    """A part of one side of a picture that a window keeps.

    Attributes:
        first: pixel.
        end: likewise, excluded.
        weight: (end - first,), of each pixel, which fades towards the neighbours'.
    """

    first: int
    end: int
    weight: Tensor


def stretches(length: int, window: int, overlap: int) -> list[Stretch]:
    """Return what windows keep along one side of a picture; weights add up to 1 at each pixel.

    Args:
        length: of the side, pixels.
        window: pixels from the middle of one overlap to that of the next, at most.
        overlap: pixels along which neighbours fade into each other, at most.
    """
    count = math.ceil(length / window)
    borders = [round(n * length / count) for n in range(count + 1)]
    half = min(overlap, min(b - a for a, b in pairwise(borders))) // 2
    found = []
    for low, high in pairwise(borders):
        first, end = max(0, low - half), min(length, high + half)
        place = torch.arange(first, end) + 0.5
        weight = torch.ones(end - first)
        if first:
            weight = weight * _rise((place - low) / max(half, 1))
        if end < length:
            weight = weight * _rise((high - place) / max(half, 1))
        found.append(Stretch(first, end, weight))
    return found


def _rise(place: Tensor) -> Tensor:
    """From 0 at -1 to 1 at 1, along a raised cosine."""
    return 0.5 + 0.5 * torch.sin(0.5 * math.pi * place.clamp(-1.0, 1.0))


def mirrored(first: int, end: int, length: int, device: torch.device | None = None) -> Tensor:
    """Return the pixels from `first` to `end` of a side; its mirror image goes on beyond it."""
    if length == 1:
        return torch.zeros(end - first, dtype=torch.long, device=device)
    index = torch.arange(first, end, device=device)
    period = 2 * (length - 1)
    folded = index.remainder(period)
    return torch.where(folded < length, folded, period - folded)


@torch.no_grad()
def restore_whole_picture(
    restorer: Restorer,
    signal: Tensor,
    readout: Readout,
    functions: Functions,
    illumination: Illumination,
    window: int,
    overlap: int = _OVERLAP,
    margin: int = _MARGIN,
) -> Tensor:
    """Restore what a sensor gave behind a lens whose blur and light change over the field.

    Relative illumination is divided out, so that a flat picture stays flat; the restorer is told
    the noise that this leaves.

    Args:
        restorer: told point spread functions and noise.
        signal: (3, H, W), or with colour filters (1, H, W), as the readout gives it.
        readout: the sensor's.
        functions: at pixels of the sensor; see `WholeField.functions`.
        illumination: likewise.
        window: pixels along each side of what is kept of a window, at most, 32 or more.
        overlap: pixels along which neighbours fade into each other.
        margin: pixels that the restorer sees around that, besides half of the functions.

    Returns:
        (3, H, W), display-encoded, not clipped.

    Raises:
        InputError: a window of fewer than 32 pixels.
    """
    height, width = signal.shape[-2:]
    if window < 32:
        raise InputError(f"window: {window}; allowed: 32 or more pixels")
    shot, read = readout.noise
    found = signal.new_zeros(3, height, width)
    across = stretches(width, window, overlap)
    for down in stretches(height, window, overlap):
        middles = torch.tensor([0.5 * (s.first + s.end - 1) for s in across])
        middle = torch.full_like(middles, 0.5 * (down.first + down.end - 1))
        known = functions(middle, middles)
        reach = margin + known.shape[-1] // 2
        # Even, so that windows of a mosaic begin with the same filter.
        rows = _seen(down, reach, height)
        for number, side in enumerate(across):
            columns = _seen(side, reach, width)
            light = illumination(rows.pixels, columns.pixels).clamp(min=_DARKEST)
            raw = readout.develop(signal[:, rows.pixels[:, None], columns.pixels]) / light
            mean = float(light.mean())
            noise = torch.tensor([shot / mean, read / mean**2], device=signal.device)
            restored = restorer(raw[None], known[number], None, noise)[0]
            kept = restored[:, rows.kept, columns.kept]
            weight = down.weight[:, None] * side.weight
            found[:, down.first : down.end, side.first : side.end] += kept * weight.to(kept)
    return found


class _Seen(NamedTuple):
    """The pixels of one side that a restorer sees, and which of them are kept."""

    pixels: Tensor
    kept: slice


def _seen(stretch: Stretch, reach: int, length: int) -> _Seen:
    first = stretch.first - reach
    first -= first % 2
    return _Seen(
        mirrored(first, stretch.end + reach, length),
        slice(stretch.first - first, stretch.end - first),
    )
