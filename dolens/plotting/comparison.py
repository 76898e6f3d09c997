"""Raw and restored images are shown beside the ground truth."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import PAGE, SMALL, TITLE
from dolens.plotting.titles import draw_title

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
) -> Figure:
    """Show raw images above restored ones, one column a view. The truth stands at the left where it
    is the same for all views, else above them.  Labels stand above the columns.

    Args:
        truth: (3, H, W), or (views, 3, H, W), display-encoded in [0, 1].
        raw: (views, 3, H, W), the same.
        restored: (views, 3, H, W), the same.
        labels: one a view.
        psnr: {"raw": dB per view, "restored": dB per view} for the titles, or None for none.
        title: above all.
        further: name → pictures (views, 3, H, W), shown below.

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
        axes = figure.add_subplot(grid[:, 0])
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
    return figure


def _show(axes: Axes, image: Tensor) -> None:
    picture = image.detach().cpu().float().clamp(0.0, 1.0).permute(1, 2, 0).numpy()
    axes.imshow(picture, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
