"""Signed matrices, such as how operands change with variables."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import SMALL, TITLE

# Inches a cell, and a letter of a label, takes.
_CELL, _LETTER = 0.3, 0.065


def matrix_figure(
    values: Tensor | np.ndarray,
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    title: str | None = None,
    unit: str = "",
) -> Figure:
    """A matrix in colours: red above zero, blue below, white at zero.

    Args:
        values: (R, C); what is not finite stays grey.
        row_labels: R of them.
        column_labels: C of them.
        title: above.
        unit: what the colour bar measures, with its unit.

    Raises:
        InputError: the labels do not fit.
    """
    table = torch.as_tensor(values).detach().cpu().double().numpy()
    if table.ndim != 2 or table.shape != (len(row_labels), len(column_labels)) or not table.size:
        raise InputError(
            f"a matrix of {len(row_labels)} rows and {len(column_labels)} columns cannot have "
            f"shape {table.shape}"
        )
    rows, columns = table.shape
    finite = np.abs(table[np.isfinite(table)])
    reach = float(finite.max(initial=0.0)) or 1.0
    letters = max(map(len, row_labels)), max(map(len, column_labels))
    size = (
        min(max(_CELL * columns, 2.4), 10.0) + _LETTER * letters[0] + 1.2,
        min(max(_CELL * rows, 1.6), 9.0) + _LETTER * letters[1] + 0.6,
    )
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor("0.8")
    shown = np.ma.masked_invalid(table)
    picture = axes.imshow(
        shown, cmap="RdBu_r", vmin=-reach, vmax=reach, aspect="auto", interpolation="nearest"
    )
    axes.set_xticks(
        range(columns), column_labels, rotation=90 if letters[1] > 3 else 0, fontsize=SMALL - 1
    )
    axes.set_yticks(range(rows), row_labels, fontsize=SMALL - 1)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    # White lines between the cells.
    axes.set_xticks(np.arange(columns - 1) + 0.5, minor=True)
    axes.set_yticks(np.arange(rows - 1) + 0.5, minor=True)
    axes.grid(True, which="minor", color="white", linewidth=0.6)
    axes.tick_params(which="minor", length=0)
    bar = figure.colorbar(picture, ax=axes, pad=0.02, fraction=0.06)
    bar.ax.tick_params(labelsize=SMALL - 1)
    bar.outline.set_visible(False)
    if unit:
        bar.set_label(unit, fontsize=SMALL)
    if title:
        axes.set_title(title, fontsize=TITLE)
    return figure
