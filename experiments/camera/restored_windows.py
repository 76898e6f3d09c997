"""Restored pictures of any size: a network is applied to overlapping windows, without seams.

A pixel of a restored picture depends on the raw image around it.  How far that reaches is measured:
the gradient of restored pixels with respect to the raw image says how much each raw pixel counts.
Windows overlap by at least that much, so that where one ends has no influence on what is kept of
it; beyond the picture's edges they see its mirror image.  Networks that halve an image several
times see it on a grid; windows begin on multiples of 64 pixels, which all such grids have in
common.
"""

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.reconstruction import evaluating
from dolens.reconstruction import Restoration, UntrainedRestoration
from dolens.reconstruction.whole_pictures import mirrored

GRID = 64
DEFAULT_WINDOW = 512
# Of full scale: how much raw pixels beyond the margin may change a restored value, to first order,
# where all of them change by full scale, alike or each by itself.
_INFLUENCE = 2e-5
_FIRST_PROBE, _LARGEST_PROBE = 256, 512
# Restored pixels that are looked at, from the middle of the probe: at several places of the grid.
_LOOKED_AT = ((0, 0), (3, 7), (10, 13))


@dataclass(frozen=True)
class Window:
    """A part of an image that a network is applied to, and what of it is kept.

    Attributes:
        rows: first row and end of what is kept; the network sees the margin on both sides besides.
        columns: likewise.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]


def windows(height: int, width: int, window: int) -> Iterator[Window]:
    """Yield the windows of an image, row after row; what they keep covers it once.

    Args:
        height: of the image, pixels.
        width: likewise.
        window: pixels along each side of what is kept, a multiple of `GRID`.
    """
    for rows in _stretches(height, window):
        for columns in _stretches(width, window):
            yield Window(rows, columns)


def _stretches(length: int, window: int) -> list[tuple[int, int]]:
    return [(start, min(start + window, length)) for start in range(0, length, window)]


def margin_of(
    network: Restoration,
    functions: Tensor | None,
    device: torch.device,
    largest: int = _LARGEST_PROBE,
    noise: Sequence[Tensor] = (),
    readouts: int | None = None,
) -> int | None:
    """Measure how far the network looks, in pixels, as a multiple of `GRID`.

    Args:
        network: in any mode; it is measured in evaluation mode.
        functions: point spread functions (D, 3, K, K), where the network asks for them.
        device: of both.
        largest: side of the largest probe image, pixels.
        noise: of the sensor, where the network asks for it; see `Camera.noise`.
        readouts: of an image; None: one, and no list of it.

    Returns:
        The margin; None where the network looks farther than half the largest probe, as one does
        that measures a whole image's brightness, or has no gradient to measure it by.
    """
    if isinstance(network, UntrainedRestoration):
        return None
    size = _FIRST_PROBE
    while size <= largest:
        reach = _reach(network, functions, size, device, noise, readouts)
        # Near the probe's edge less is seen than there would be.
        if reach < size // 2 - GRID // 2:
            return max(GRID, GRID * math.ceil(reach / GRID))
        size *= 2
    return None


def _reach(
    network: Restoration,
    functions: Tensor | None,
    size: int,
    device: torch.device,
    noise: Sequence[Tensor],
    readouts: int | None,
) -> int:
    """The distance, by rows or columns, beyond which raw pixels hardly change the middle ones."""
    # In double precision: rounding in a transform would look like an influence of all pixels.
    network = copy.deepcopy(network).double()
    options = {"dtype": torch.float64, "device": device}
    generator = torch.Generator().manual_seed(0)
    shape = (1, 3, size, size) if readouts is None else (1, readouts, 3, size, size)
    raw = torch.rand(shape, generator=generator).to(**options).requires_grad_(True)
    field = torch.zeros(1, 2, size, size, **options) if network.needs_field else None
    functions = None if functions is None else functions.double()
    middle, farthest = size // 2, 0
    with evaluating(network), torch.enable_grad():
        restored = network(raw, functions, field, *noise)
        for down, across in _LOOKED_AT:
            row, column = middle + down, middle + across
            (gradient,) = torch.autograd.grad(
                restored[0, :, row, column].sum(), raw, retain_graph=True
            )
            rows = (torch.arange(size, device=device) - row).abs()
            columns = (torch.arange(size, device=device) - column).abs()
            distance = torch.maximum(rows[:, None], columns)
            alike = gradient[0].flatten(0, -3).sum(dim=0)
            each = gradient[0].flatten(0, -3).square().sum(dim=0)
            together = _beyond(distance, alike).abs(), _beyond(distance, each).sqrt()
            counts = torch.nonzero(torch.maximum(*together) > _INFLUENCE).flatten()
            farthest = max(farthest, int(counts[-1]) + 1 if len(counts) else 0)
    return farthest


def _beyond(distance: Tensor, share: Tensor) -> Tensor:
    """Sums of what lies at each distance or farther."""
    rings = torch.zeros(len(distance), dtype=share.dtype, device=share.device)
    rings.index_add_(0, distance.flatten(), share.flatten())
    return rings.flip(0).cumsum(0).flip(0)


@torch.no_grad()
def restore_in_windows(
    network: Restoration,
    raw: Tensor,
    functions: Tensor | None,
    field: Tensor | None,
    window: int = DEFAULT_WINDOW,
    margin: int | None = None,
    noise: Sequence[Tensor] = (),
) -> Tensor:
    """Restore an image of any size.

    Args:
        network: the camera's.
        raw: (1, 3, H, W), linear light, or of readouts (1, N, 3, H, W).
        functions: point spread functions, where the network asks for them.
        field: (1, 2, H, W), where it asks for places.
        window: pixels along each side of what is kept of a window, a multiple of 64.
        margin: see `margin_of`; None: the whole image at once.
        noise: of the sensor, where the network asks for it; see `Camera.noise`.

    Returns:
        (1, 3, H, W), display-encoded, not clipped, in the network's precision.

    Raises:
        InputError: a window that is no multiple of 64.
    """
    if window < GRID or window % GRID:
        raise InputError(f"--window: {window}; allowed: multiples of {GRID}, pixels")
    height, width = raw.shape[-2:]
    with evaluating(network):
        if margin is None:
            return network(raw, functions, field, *noise)
        found = torch.empty(1, 3, height, width, dtype=network.dtype, device=raw.device)
        inner = slice(margin, -margin)
        for part in windows(height, width, window):
            (top, bottom), (left, right) = part.rows, part.columns
            rows = mirrored(top - margin, bottom + margin, height, raw.device)
            columns = mirrored(left - margin, right + margin, width, raw.device)
            seen = (..., rows[:, None], columns)
            places = None if field is None else field[seen]
            restored = network(raw[seen], functions, places, *noise)
            found[..., slice(*part.rows), slice(*part.columns)] = restored[..., inner, inner]
    return found
