"""Point spread functions are shown as colour images."""

import math
from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.number_text import number_text
from dolens.plotting.scale_bar import scale_bar
from dolens.plotting.style import PAGE, SMALL, TITLE
from dolens.plotting.titles import draw_title
from dolens.sensor.colour import linear_to_srgb

_ENERGY = 0.998
_COLUMNS = 4
_PANEL = 2.1
_SMALLEST_WINDOW = 7


@torch.no_grad()
def psf_figure(
    psfs: Tensor, labels: Sequence[str], pixel_pitch_mm: float, title: str | None = None
) -> Figure:
    """Show point spread functions, one panel a depth, in colour and normalised to their own peak.

    All panels show the same square window: one that holds 99.8 % of the light of each function, and
    little more.  It need not be about the middle.

    Args:
        psfs: (depths, 3, K, K), linear light; the channels are shown as red, green and blue.
        labels: one a depth, written above its panel.
        pixel_pitch_mm: for the scale bar.
        title: above all panels.

    Returns:
        A figure.  The number above a panel is its peak in the units of `psfs`: for functions of
        unit sum, the share of a channel's light in its brightest pixel.
    """
    if psfs.ndim != 4 or psfs.shape[1] != 3 or psfs.shape[2] != psfs.shape[3]:
        raise InputError(f"psfs must be (depths, 3, K, K), not {tuple(psfs.shape)}")
    if len(labels) != len(psfs):
        raise InputError(f"{len(psfs)} depths need as many labels, not {len(labels)}")
    psfs = psfs.detach().cpu().double()
    top, left, size = window_of_light(psfs.sum(1))
    window = psfs[..., top : top + size, left : left + size]
    peaks = window.amax((1, 2, 3))
    scale = torch.where(peaks > 0.0, peaks, 1.0).view(-1, 1, 1, 1)
    pictures = linear_to_srgb(window / scale).permute(0, 2, 3, 1).numpy()

    rows = math.ceil(len(psfs) / _COLUMNS)
    columns = math.ceil(len(psfs) / rows)
    panel = min(_PANEL, PAGE / columns)
    note = "each to its own peak, display-encoded (sRGB), not interpolated"
    heading = 0.2 * (2 + (title.count("\n") if title else 0))
    figure = Figure(
        figsize=(max(panel * columns, 5.2), (panel + 0.6) * rows + heading), layout="constrained"
    )
    for number, (picture, label, peak) in enumerate(zip(pictures, labels, peaks, strict=True)):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.imshow(picture, interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{label}\npeak {number_text(float(peak), 2)}", fontsize=SMALL)
        if number == 0:
            scale_bar(axes, size, pixel_pitch_mm)
    draw_title(figure, f"{title}\n{note}" if title else note, TITLE if title else SMALL)
    return figure


def window_of_light(light: Tensor, share: float = _ENERGY) -> tuple[int, int, int]:
    """Return top, left and side of a square that holds a share of each image's light.

    Rows and columns are taken from the side where the least light is, one by one.

    Args:
        light: (N, K, K), none negative.
        share: of the light of each; dark images do not count.
    """
    size = light.shape[-1]
    total = light.sum((-2, -1))
    light = light[total > 0.0] / total[total > 0.0, None, None]
    # Sums over rectangles are differences of these.
    sums = torch.nn.functional.pad(light.cumsum(-2).cumsum(-1), (1, 0, 1, 0))

    def held(box: tuple[int, int, int, int]) -> float:
        top, bottom, left, right = box
        found = sums[:, bottom, right] - sums[:, top, right]
        found = found - sums[:, bottom, left] + sums[:, top, left]
        return float(found.min()) if len(found) else 0.0

    box = (0, size, 0, size)
    while True:
        top, bottom, left, right = box
        smaller = []
        if bottom - top > 1:
            smaller += [(top + 1, bottom, left, right), (top, bottom - 1, left, right)]
        if right - left > 1:
            smaller += [(top, bottom, left + 1, right), (top, bottom, left, right - 1)]
        best = max(smaller, key=held, default=None)
        if best is None or held(best) < share:
            break
        box = best
    if not len(light):
        box = (size // 2, size // 2 + 1, size // 2, size // 2 + 1)
    top, bottom, left, right = box
    # One pixel of dark around, where there is room.
    side = min(max(bottom - top + 2, right - left + 2, min(size, _SMALLEST_WINDOW)), size)

    def start(low: int, high: int) -> int:
        return min(max((low + high - side) // 2, 0), size - side)

    return start(top, bottom), start(left, right), side
