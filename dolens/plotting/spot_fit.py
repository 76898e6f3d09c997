"""Measured images of point sources are shown beside a model before and after its fit."""

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.scale_bar import scale_bar
from dolens.plotting.style import PAGE, SMALL
from dolens.plotting.titles import draw_title

_COLUMNS = ("measured", "initial", "final", "final \N{MINUS SIGN} measured")
# Light left out beyond each edge of the window, as a share, before the margin is added.
_BEYOND = 0.002
_MARGIN = 0.12
_SMALLEST_WINDOW = 8
# Near the focus most light is in a few pixels.  Where the mean is below this share of the brightest
# pixel, colours follow the square root, so that the rest is seen.
_PEAKED = 0.05
# Inches, of an image with its heading and scale bar.
_ROW = 1.75


@torch.no_grad()
def spot_fit_figure(
    measured: Tensor,
    initial: Tensor,
    final: Tensor,
    labels: Sequence[str],
    pixel_pitch: float,
    title: str | None = None,
) -> Figure:
    """Show one row for each image: measured, at the start of the fit, at its end, and the residual.

    Each row shows one square window where the light of its three images is, and is relative to the
    largest pixel that was measured.  The colours reach as far as the brightest of the three, so
    that nothing is clipped; each one's peak is written above it.
    Differences are red where the model has too much light, blue where too little.

    Args:
        measured: (N, height, width), shares of light; sensor noise may be below zero.
        initial: likewise.
        final: likewise.
        labels: N of them, of the rows.
        pixel_pitch: mm, for the scale bars.
        title: above all.

    Raises:
        InputError: shapes or labels that do not fit, no row, or a measured image without light.
    """
    images = [found.detach().cpu().double() for found in (measured, initial, final)]
    count = len(labels)
    if not count or any(i.ndim != 3 or i.shape != (count, *images[0].shape[1:]) for i in images):
        shapes = ", ".join(str(tuple(i.shape)) for i in images)
        raise InputError(f"{count} labels, and images of shapes {shapes}; all: (N, height, width)")
    if not bool((images[0].sum((-2, -1)) > 0.0).all()):
        raise InputError("a measured image has no light")
    figure = Figure(
        figsize=(PAGE, _ROW * count + (0.6 if title else 0.35)),
        layout="constrained",
    )
    grid = figure.subplots(count, 4, squeeze=False)
    for number, (label, line) in enumerate(zip(labels, grid, strict=True)):
        _row(figure, line, [found[number] for found in images], pixel_pitch)
        line[0].set_ylabel(label, fontsize=SMALL + 1)
    for axes, name in zip(grid[0], _COLUMNS, strict=True):
        below = f"\n{axes.get_title()}" if axes.get_title() else ""
        axes.set_title(f"{name}{below}", fontsize=SMALL)
    draw_title(figure, title)
    return figure


def _row(figure: Figure, line: Sequence[Axes], images: list[Tensor], pitch: float) -> None:
    top, left, size = _window(images)
    peak = images[0].max()
    shown = [i[top : top + size, left : left + size] / peak for i in images]
    brightest = max(float(picture.max()) for picture in shown)
    peaked = float(shown[0].mean()) < _PEAKED * brightest
    gamma = 0.5 if peaked else 1.0
    for axes, picture in zip(line, shown, strict=False):
        norm = PowerNorm(gamma, vmin=0.0, vmax=brightest)
        bright = axes.imshow(picture.numpy(), cmap="inferno", norm=norm, interpolation="nearest")
        axes.set_title(f"peak {float(picture.max()):.2f}", fontsize=SMALL)
    left_over = 100.0 * (shown[2] - shown[0])
    reach = float(left_over.abs().max()) or 1.0
    differing = line[3].imshow(
        left_over.numpy(), cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="nearest"
    )
    for drawn, owners, name in (
        (bright, line[:3], f"over measured peak\n(no unit{', square-root scale' * peaked})"),
        (differing, line[3], "difference (%)"),
    ):
        bar = figure.colorbar(drawn, ax=owners, fraction=0.05, pad=0.02)
        bar.set_label(name, fontsize=SMALL - 1)
        bar.ax.tick_params(labelsize=SMALL - 1)
        bar.outline.set_visible(False)
    for axes in line:
        axes.set(xticks=[], yticks=[])
    scale_bar(line[0], shown[0].shape[-1], pitch)


def _window(images: list[Tensor]) -> tuple[int, int, int]:
    """Return top, left and side (pixels) of a square that holds nearly all light of all images."""
    height, width = images[0].shape
    ends = []
    for direction in (1, 0):
        lows, highs = [], []
        for image in images:
            cumulated = image.sum(direction).cumsum(0)
            if float(cumulated[-1]) <= 0.0:
                continue
            inside = (cumulated > _BEYOND * cumulated[-1]) & (
                cumulated < (1.0 - _BEYOND) * cumulated[-1]
            )
            places = inside.nonzero().flatten()
            # All light in one pixel crosses both bounds at once.
            lows.append(int(places.min()) if len(places) else int(image.sum(direction).argmax()))
            highs.append(int(places.max()) + 1 if len(places) else lows[-1])
        ends.append((min(lows), max(highs)))
    longest = max(high - low + 1 for low, high in ends)
    side = max(round((1.0 + 2.0 * _MARGIN) * longest), _SMALLEST_WINDOW)
    side = min(side, height, width)
    starts = [
        min(max(round(0.5 * (low + high + 1 - side)), 0), length - side)
        for (low, high), length in zip(ends, (height, width), strict=True)
    ]
    return starts[0], starts[1], side
