"""Figures are written to files, shown in notebooks, or converted to image tensors."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import check_choice

FORMATS = ("png", "pdf", "svg")
# Dots per inch of the figure's size: two pixels for each that a screen of 96 dpi shows.
_DPI = 200.0
# Text stays text in PDF, and files of one figure are the same whenever they are written.
_SETTINGS: Any = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "dolens"}
_DATES = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def save_figure(figure: Figure, path: str | Path, dpi: float = _DPI) -> None:
    """Write a figure to a file; missing folders are created.

    Args:
        figure: any figure.
        path: its suffix (.png, .pdf, .svg) chooses the format.

    Rarely needed:
        dpi: pixels per inch of the figure's size; in PDF and SVG, of what is an image there.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context(_SETTINGS), laid_out(figure):
        figure.savefig(path, dpi=dpi, metadata=_DATES.get(path.suffix.removeprefix(".").lower()))


def save_figures(
    figure: Figure, path: str | Path, formats: Sequence[str] = ("png",), dpi: float = _DPI
) -> list[Path]:
    """Write a figure in several formats.

    Args:
        figure: any figure.
        path: without suffix.
        formats: of `png`, `pdf`, `svg`.
        dpi: pixels per inch of the figure's size; in PDF and SVG, of what is an image there.

    Returns:
        The files, in the order of the formats.

    Raises:
        InputError: another format.
    """
    for name in formats:
        check_choice(name, FORMATS, "formats")
    paths = [Path(f"{path}.{name}") for name in formats]
    with laid_out(figure):
        for written in paths:
            save_figure(figure, written, dpi)
    return paths


@contextmanager
def laid_out(figure: Figure) -> Iterator[None]:
    """Lay a figure out for all that is drawn of it within the context.

    A layout takes as long as a drawing, and Matplotlib would make one, and a drawing that nobody
    sees, for each file.

    Args:
        figure: any figure; it has its layout engine again afterwards.
    """
    engine = figure.get_layout_engine()
    if engine is None:
        yield
        return
    # Tick labels are known once axes have their size: labels at the edge fit after two passes.
    for _ in range(2):
        engine.execute(figure)
    with rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)
    try:
        yield
    finally:
        figure.set_layout_engine(engine)


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


def showing(figure: Figure) -> Figure:
    """Return the same figure, with the picture that IPython asks an object for.

    IPython's own formatter for figures exists only where pyplot was set up; where it does, it comes
    first and this is not asked, so that a figure is shown once.
    """
    figure._repr_png_ = partial(png_of, figure)  # type: ignore[attr-defined]
    return figure


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()
