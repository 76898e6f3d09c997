"""This module draws how many lenses of a series make how good a camera."""

from collections.abc import Mapping

import torch
from matplotlib.figure import Figure
from torch import Tensor


def made_lenses_figure(
    scores: Mapping[str, Tensor], drawn: Mapping[str, float], passing: float, title: str
) -> Figure:
    """Draw the share of lenses that reach a PSNR.

    Args:
        scores: name of a series → PSNR of each lens, (N,), dB.
        drawn: name → PSNR of its lens as drawn, dB.
        passing: the least PSNR of a lens that passes, dB.
        title: of the figure.
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, found) in enumerate(scores.items()):
        ascending = found.sort().values
        share = 1.0 - torch.arange(len(ascending)) / len(ascending)
        colour = f"C{number}"
        axes.step(ascending, 100.0 * share, where="pre", color=colour, label=name)
        axes.axvline(drawn[name], color=colour, linestyle=":", label=f"{name}, lens as drawn")
    axes.axvline(passing, color="0.5", linewidth=0.8, label="passes")
    axes.set_xlabel("PSNR of the worst view, dB")
    axes.set_ylabel("lenses that reach it, %")
    axes.set_ylim(0.0, 103.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    axes.set_title(title, fontsize="medium")
    return figure
