"""Images are shown side by side: raw, restored and true ones, a picture through a lens, and
measured points beside a fitted model.
"""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError
from dolens.photograph_page.page import most_detailed
from dolens.plotting.style import PAGE, SMALL, TITLE, draw_note, draw_title, plain_text, scale_bar

# Inches: a picture is shown about one to one at 120 dpi, unless that is tiny or huge.
_SMALLEST, _LARGEST = 1.7, 3.2
_DPI = 120
# Wide enough for a title.
_NARROWEST = 5.0
# The label above each column.
_LABEL = 0.15


@torch.no_grad()
def comparison_figure(
    truth: Tensor,
    raw: Tensor,
    restored: Tensor,
    labels: Sequence[str],
    psnr: Mapping[str, Sequence[float]] | None = None,
    title: str | None = None,
    further: Mapping[str, Tensor] | None = None,
    note: str = "",
) -> Figure:
    """Show raw images above restored ones, one column a view. The truth stands at the left where it
    is the same for all views, beside the raw images, else above them.  Labels stand above the
    columns.

    Args:
        truth: (3, H, W), or (views, 3, H, W), display-encoded in [0, 1].
        raw: (views, 3, H, W), the same.
        restored: (views, 3, H, W), the same.
        labels: one a view.
        psnr: {"raw": dB per view, "restored": dB per view} for the titles, or None for none.
        title: above all.
        further: name → pictures (views, 3, H, W), shown below.
        note: how the pictures are shown and measured, below all.

    Returns:
        A figure whose pictures are not interpolated; values are clipped to [0, 1].
    """
    if (
        raw.ndim != 4
        or raw.shape != restored.shape
        or truth.shape not in (raw.shape, raw.shape[1:])
    ):
        raise InputError(
            "expected truth (3, H, W) or as the others, raw and restored (views, 3, H, W), not "
            f"{tuple(truth.shape)}, {tuple(raw.shape)}, {tuple(restored.shape)}"
        )
    views = len(raw)
    if len(labels) != views:
        raise InputError(f"{views} views need as many labels, not {len(labels)}")
    if truth.ndim == 4 and torch.equal(truth, truth[:1].expand_as(truth)):
        truth = truth[0]
    images = {"raw": raw, "restored": restored, **(further or {})}
    if truth.ndim == 4:
        images = {"truth": truth, **images}
    beside = int(truth.ndim == 3)

    height, width = truth.shape[-2:]
    columns = views + beside
    panel = min(min(max(width / _DPI, _SMALLEST), _LARGEST), (PAGE - 0.2) / columns)
    tall = panel * height / width + 0.35
    heading = (0.2 * (title.count("\n") + 1) + 0.1 if title else 0.0) + _LABEL
    figure = Figure(
        figsize=(max(panel * columns + 0.2, _NARROWEST), len(images) * tall + heading),
        layout="constrained",
    )
    grid = figure.add_gridspec(len(images), columns)
    if beside:
        axes = figure.add_subplot(grid[0, 0])
        _show(axes, truth)
        axes.set_title("truth", fontsize=SMALL)
    for row, (name, stack) in enumerate(images.items()):
        for column, (image, label) in enumerate(zip(stack, labels, strict=True)):
            axes = figure.add_subplot(grid[row, column + beside])
            _show(axes, image)
            of_this = None if psnr is None else psnr.get(name)
            said = "" if of_this is None else f": {float(of_this[column]):.1f} dB"
            above = f"{label}\n" if row == 0 else ""
            axes.set_title(f"{above}{name}{said}", fontsize=SMALL)
    draw_title(figure, title, TITLE - 1)
    if note:
        draw_note(figure, note)
    return figure


def _show(axes: Axes, image: Tensor) -> None:
    picture = image.detach().cpu().float().clamp(0.0, 1.0).permute(1, 2, 0).numpy()
    axes.imshow(picture, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


_PANEL = 3.6  # inches
_PART = 160  # pixels along each side of the part
_WHOLE = 720  # pixels along the longer side of a whole picture


@torch.no_grad()
def applied_figure(
    images: Mapping[str, Tensor], psnr: Mapping[str, float], title: str = ""
) -> Figure:
    """Show images side by side; below, the part of the first one that has the most detail.

    Args:
        images: name → (3, H, W), display-encoded in [0, 1], all of one size.
        psnr: name → dB, for titles.
        title: of the figure.
    """
    images = {name: image.detach().cpu() for name, image in images.items()}
    first = next(iter(images.values()))
    height, width = first.shape[-2:]
    side = min(_PART, height, width)
    top, left = most_detailed(first, side)
    tall = min(max(height / width, 0.3), 2.0) * _PANEL
    figure = Figure(figsize=(_PANEL * len(images) + 0.2, tall + _PANEL + 0.8), layout="constrained")
    axes = figure.subplots(2, len(images), squeeze=False, height_ratios=(tall, _PANEL))
    for column, (label, image) in enumerate(images.items()):
        name = plain_text(label)
        quality = f", {psnr[label]:.1f} dB" if label in psnr else ""
        whole, part = axes[0, column], axes[1, column]
        whole.imshow(_pixels(_shrunk(image)), extent=(0, width, height, 0), interpolation="nearest")
        whole.add_patch(
            Rectangle((left, top), side, side, fill=False, color="white", linewidth=1.6)
        )
        whole.add_patch(
            Rectangle((left, top), side, side, fill=False, color="black", linewidth=0.7)
        )
        part.imshow(
            _pixels(image[:, top : top + side, left : left + side]), interpolation="nearest"
        )
        whole.set_title(f"{name}{quality}", fontsize=SMALL)
        part.set_title(f"{name}, {side}×{side} pixels", fontsize=SMALL)
        for panel in (whole, part):
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
    draw_title(figure, title)
    return figure


def _shrunk(image: Tensor) -> Tensor:
    longer = max(image.shape[-2:])
    if longer <= _WHOLE:
        return image
    size = [max(1, round(length * _WHOLE / longer)) for length in image.shape[-2:]]
    return functional.interpolate(image[None], size, mode="area")[0]


def _pixels(image: Tensor) -> object:
    return image.float().clamp(0.0, 1.0).permute(1, 2, 0).numpy()


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
