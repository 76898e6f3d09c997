"""What the sensor saw and what was restored, beside the truth."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import SMALL

# Inches: a picture is shown about one to one at 120 dpi, unless that is tiny or huge.
_SMALLEST, _LARGEST = 1.7, 3.2
_DPI = 120


@torch.no_grad()
def comparison_figure(
    truth: Tensor,
    raw: Tensor,
    restored: Tensor,
    labels: Sequence[str],
    psnr: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """The truth at the left; raw images above restored ones, one column a depth.

    Args:
        truth: (3, H, W), display-encoded in [0, 1].
        raw: (depths, 3, H, W), the same.
        restored: (depths, 3, H, W), the same.
        labels: one a depth.
        psnr: {"raw": dB per depth, "restored": dB per depth} for the titles, or None for none.

    Returns:
        A figure whose pictures are not interpolated.
    """
    if raw.ndim != 4 or raw.shape != restored.shape or raw.shape[1:] != truth.shape:
        raise InputError(
            "expected truth (3, H, W), raw and restored (depths, 3, H, W), not "
            f"{tuple(truth.shape)}, {tuple(raw.shape)}, {tuple(restored.shape)}"
        )
    depths = len(raw)
    if len(labels) != depths:
        raise InputError(f"{depths} depths need as many labels, not {len(labels)}")
    images = {"raw": raw, "restored": restored}

    height, width = truth.shape[-2:]
    panel = min(max(width / _DPI, _SMALLEST), _LARGEST)
    size = (panel * (depths + 1) + 0.2, 2.0 * (panel * height / width + 0.4))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(2, depths + 1)
    axes = figure.add_subplot(grid[:, 0])
    _show(axes, truth)
    axes.set_title("truth", fontsize=SMALL)
    for row, (name, stack) in enumerate(images.items()):
        for column, (image, label) in enumerate(zip(stack, labels, strict=True)):
            axes = figure.add_subplot(grid[row, column + 1])
            _show(axes, image)
            quality = "" if psnr is None else f": {float(psnr[name][column]):.1f} dB"
            axes.set_title(f"{name}, {label}{quality}", fontsize=SMALL)
    return figure


def _show(axes: Axes, image: Tensor) -> None:
    picture = image.detach().cpu().float().clamp(0.0, 1.0).permute(1, 2, 0).numpy()
    axes.imshow(picture, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
