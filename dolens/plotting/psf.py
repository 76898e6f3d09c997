"""Point spread functions are shown as colour images."""

import math
from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import SMALL, TITLE
from dolens.sensor.colour import linear_to_srgb

_ENERGY = 0.995
_COLUMNS = 6
_PANEL = 2.1
_SMALLEST_WINDOW = 7


@torch.no_grad()
def psf_figure(
    psfs: Tensor, labels: Sequence[str], pixel_pitch_mm: float, title: str | None = None
) -> Figure:
    """Show point spread functions, one panel a depth, in colour and normalised to their own peak.

    All panels show the same central window: the smallest that holds 99.5 % of each depth's energy.

    Args:
        psfs: (depths, 3, K, K), linear light; the channels are shown as red, green and blue.
        labels: one a depth, written above its panel.
        pixel_pitch_mm: for the scale bar.
        title: above all panels.

    Returns:
        A figure.  The number in a panel is its peak in the units of `psfs`: for functions of unit
        sum, the share of a channel's light in its brightest pixel.
    """
    if psfs.ndim != 4 or psfs.shape[1] != 3 or psfs.shape[2] != psfs.shape[3]:
        raise InputError(f"psfs must be (depths, 3, K, K), not {tuple(psfs.shape)}")
    if len(labels) != len(psfs):
        raise InputError(f"{len(psfs)} depths need as many labels, not {len(labels)}")
    psfs = psfs.detach().cpu().double()
    margin = _crop_margin(psfs)
    size = psfs.shape[-1] - 2 * margin
    window = psfs[..., margin : margin + size, margin : margin + size]
    peaks = window.amax((1, 2, 3))
    scale = torch.where(peaks > 0.0, peaks, 1.0).view(-1, 1, 1, 1)
    pictures = linear_to_srgb(window / scale).permute(0, 2, 3, 1).numpy()

    columns = min(len(psfs), _COLUMNS)
    rows = math.ceil(len(psfs) / columns)
    heading = 0.35 if title else 0.0
    figure = Figure(
        figsize=(_PANEL * columns, (_PANEL + 0.25) * rows + heading), layout="constrained"
    )
    for panel, (picture, label, peak) in enumerate(zip(pictures, labels, peaks, strict=True)):
        axes = figure.add_subplot(rows, columns, panel + 1)
        axes.imshow(picture, interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.set_title(label, fontsize=SMALL + 1)
        text = f"peak {float(peak):.2g}"
        axes.text(0.04, 0.95, text, color="white", va="top", fontsize=7, transform=axes.transAxes)
        if panel == 0:
            _scale_bar(axes, size, pixel_pitch_mm)
    if title:
        figure.suptitle(title, fontsize=TITLE)
    return figure


def _crop_margin(psfs: Tensor) -> int:
    """Return the pixels to leave out on every side."""
    size = psfs.shape[-1]
    light = psfs.sum(1)
    total = light.sum((-2, -1))
    for margin in range((size - min(size, _SMALLEST_WINDOW)) // 2, 0, -1):
        kept = light[:, margin : size - margin, margin : size - margin].sum((-2, -1))
        if bool((kept >= _ENERGY * total).all()):
            return margin
    return 0


def _scale_bar(axes: Axes, size: int, pixel_pitch_mm: float) -> None:
    """Draw a bar of a round number of pixels, at most 0.4 of the window, at the lower left."""
    steps = [factor * 10**power for power in range(5) for factor in (1, 2, 5)]
    pixels = max(step for step in steps if step == 1 or step <= 0.4 * size)
    left, bottom = -0.5 + 0.05 * size, -0.5 + 0.94 * size
    axes.plot(
        [left, left + pixels], [bottom, bottom], color="white", linewidth=2, solid_capstyle="butt"
    )
    text = f"{pixels} px = {pixels * pixel_pitch_mm * 1e3:.3g} µm"
    axes.text(left, bottom - 0.025 * size, text, color="white", va="bottom", fontsize=7)
