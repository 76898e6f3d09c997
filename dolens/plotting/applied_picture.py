"""A picture, what a sensor sees of it, and what is restored: whole, and a part one to one."""

from collections.abc import Mapping

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor
from torch.nn import functional

from dolens.plotting.captions import plain_text
from dolens.plotting.style import SMALL
from dolens.plotting.titles import draw_title

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
    top, left = _most_detailed(first, side)
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


def _most_detailed(image: Tensor, side: int) -> tuple[int, int]:
    """The first row and column of the square whose neighbouring pixels differ most."""
    grey = image.mean(dim=0, keepdim=True)
    detail = grey.diff(dim=-1)[:, :-1].square() + grey.diff(dim=-2)[..., :-1].square()
    step = max(1, side // 4)
    size = min(side, *detail.shape[-2:])
    found = functional.avg_pool2d(detail[None], size, stride=step)[0, 0]
    row, column = divmod(int(found.argmax()), found.shape[1])
    return row * step, column * step


def _shrunk(image: Tensor) -> Tensor:
    longer = max(image.shape[-2:])
    if longer <= _WHOLE:
        return image
    size = [max(1, round(length * _WHOLE / longer)) for length in image.shape[-2:]]
    return functional.interpolate(image[None], size, mode="area")[0]


def _pixels(image: Tensor) -> object:
    return image.float().clamp(0.0, 1.0).permute(1, 2, 0).numpy()
