"""Figures are written to files or converted to image tensors."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor


def save_figure(figure: Figure, path: str | Path, dpi: float = 120) -> None:
    """Write a figure to a file; missing folders are created.

    Args:
        figure: any figure.
        path: its suffix (.png, .pdf, .svg) chooses the format.

    Rarely needed:
        dpi: pixels per inch of the figure's size.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)


def figure_to_image(figure: Figure, dpi: float = 80) -> Tensor:
    """Render a figure into a tensor, as TensorBoard's `add_image` takes it.

    Args:
        figure: any figure; its own resolution is left as it was.

    Rarely needed:
        dpi: pixels per inch of the figure's size.

    Returns:
        (3, height, width), uint8, RGB.
    """
    canvas = FigureCanvasAgg(figure)
    before = figure.get_dpi()
    figure.set_dpi(dpi)
    try:
        canvas.draw()
        rgb = np.array(canvas.buffer_rgba())[..., :3]
    finally:
        figure.set_dpi(before)
    return torch.from_numpy(rgb.transpose(2, 0, 1).copy())
