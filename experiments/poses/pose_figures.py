"""Figures of Cramér–Rao bounds for arrangements of sources and planes, and labels of poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from dolens.alignment.information import FisherInformation
from dolens.alignment.pose import Pose
from dolens.experiments.experiment import Figures
from dolens.plotting.parameter_fits import corner_figure
from dolens.plotting.style import (
    DASHES,
    MARKERS,
    MINUS,
    PAGE,
    SMALL,
    colours,
    draw_title,
    legend_below,
    log_ticks,
    number_text,
    ruled_axes,
)
from dolens.plotting.tolerances import parameter_label


def image_labels(sources: int, planes: Sequence[float]) -> list[str]:
    """Return the source and the plane (mm) of each image, as far as there are several.

    The images of a source on all planes follow one another, as `Pose.images` gives them.
    """
    return [
        (f", source {source + 1}" if sources > 1 else "")
        + (f"\nplane {number_text(plane)} mm" if len(planes) > 1 else "")
        for source in range(sources)
        for plane in planes
    ]


# An eigenvector with a larger standard deviation, in the scales, is not seen at all.
UNSEEN = 1e4


@dataclass(frozen=True)
class Arrangement:
    """Holds sources and planes, and the information in their images.

    Attributes:
        name: of the arrangement.
        pose: the lens where it is; its variables are what is unknown.
        information: that the images carry on it.
        spread: (P,), standard deviations along the eigenvectors of θ/scale, the largest first.
        eigenvectors: (P, P), of the Fisher information, one a row.
        estimates: (M, P), degrees and mm, from M measurements with other photons; None: none.
    """

    name: str
    pose: Pose
    information: FisherInformation
    spread: Tensor
    eigenvectors: Tensor
    estimates: Tensor | None

    @property
    def bounds(self) -> Tensor:
        """Return bounds (P,), degrees and mm."""
        return self.information.bounds / self.pose.units


def bounds_figures(arrangements: Sequence[Arrangement], name: str, photons: float) -> Figures:
    """Return `knowledge`, and `corner_<arrangement>` of those that tell all variables.

    Args:
        arrangements: what was found.
        name: the lens and its aperture, for titles.
        photons: of all images of an arrangement together.
    """
    figures = {"knowledge": partial(_overview, arrangements, name, photons)}
    for found in arrangements:
        if float(found.spread[0]) < UNSEEN:
            figures[f"corner_{found.name}"] = partial(_corner_of_bounds, found, name)
    return figures


def _overview(arrangements: Sequence[Arrangement], name: str, photons: float) -> Figure:
    rows = len(_names(arrangements))
    heights = (0.36 * rows + 0.7, 3.0, 0.42 * len(arrangements) + 1.2)
    figure = Figure(figsize=(PAGE, sum(heights) + 1.1), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, height_ratios=heights)
    _bounds(top, arrangements)
    _spectrum(middle, arrangements)
    _worst(bottom, arrangements, figure)
    for axes, letter in zip((top, middle, bottom), "abc", strict=True):
        axes.set_title(f"({letter})", loc="left", fontsize=SMALL + 1, fontweight="bold")
    handles, labels = middle.get_legend_handles_labels()
    unseen = Line2D([], [], color="0.3", marker=">", markerfacecolor="none", linestyle="none")
    legend_below(figure, [*handles, unseen], 2, [*labels, "cannot be seen"])
    draw_title(
        figure,
        f"{name}\nCramér–Rao bounds of its pose from images of {number_text(photons)} photons "
        "in all",
    )
    return figure


def _bounds(axes: Axes, arrangements: Sequence[Arrangement]) -> None:
    """Draw bounds of each variable over its scale, a mark for each arrangement."""
    names = _names(arrangements)
    units = {
        n: u for f in arrangements for n, u in zip(f.pose.names, f.pose.unit_names, strict=True)
    }
    scales = {
        n: float(s)
        for f in arrangements
        for n, s in zip(f.pose.names, f.pose.file_scale, strict=True)
    }
    far = 0.0
    for found in arrangements:
        for name, bound in zip(found.pose.names, found.bounds.tolist(), strict=True):
            share = bound / scales[name]
            far = max(far, share if share < UNSEEN else 0.0)
    for number, (found, colour) in enumerate(_coloured(arrangements)):
        for row, name in enumerate(names):
            if name not in found.pose.names:
                continue
            share = float(found.bounds[found.pose.names.index(name)]) / scales[name]
            seen = share < UNSEEN
            offset = 0.17 * (number - 0.5 * (len(arrangements) - 1))
            axes.plot(
                share if seen else 8.0 * far,
                row + offset,
                MARKERS[number % len(MARKERS)] if seen else ">",
                color=colour,
                markersize=5 if seen else 7,
                markerfacecolor=colour if seen else "none",
            )
    labels = [
        f"{parameter_label(name)}\n(scale {scales[name]:g}{_unit(units[name])})" for name in names
    ]
    axes.set_yticks(range(len(names)), labels, fontsize=SMALL)
    axes.set_xscale("log")
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("bound over the scale of the variable (no unit)", fontsize=SMALL + 1)
    ruled_axes(axes)
    log_ticks(axes.xaxis)


def _spectrum(axes: Axes, arrangements: Sequence[Arrangement]) -> None:
    """Draw standard deviations along the eigenvectors, from the largest to the smallest."""
    for number, (found, colour) in enumerate(_coloured(arrangements)):
        spread = found.spread.clone()
        unseen = int((spread > UNSEEN).sum())
        spread[:unseen] = torch.nan
        label = _label(found) if not unseen else f"{_label(found)} ({unseen} cannot be seen)"
        axes.plot(
            np.arange(1, len(spread) + 1),
            spread.numpy(),
            marker=MARKERS[number % len(MARKERS)],
            color=colour,
            linewidth=1.0,
            linestyle=DASHES[number % len(DASHES)],
            markersize=5,
            label=label,
        )
    axes.set_yscale("log")
    axes.set_xlabel("number of the eigenvector, from the largest variance", fontsize=SMALL + 1)
    axes.set_ylabel("standard deviation\n(in scales, no unit)", fontsize=SMALL + 1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    ruled_axes(axes)


def _worst(axes: Axes, arrangements: Sequence[Arrangement], figure: Figure) -> None:
    """Draw the parts of the eigenvector of largest variance of each arrangement."""
    names = _names(arrangements)
    table = np.full((len(arrangements), len(names)), np.nan)
    for row, found in enumerate(arrangements):
        worst = found.eigenvectors[0]
        # Of one sign: its largest part is positive.
        worst = worst * torch.sign(worst[worst.abs().argmax()])
        for name, part in zip(found.pose.names, worst.tolist(), strict=True):
            table[row, names.index(name)] = part
    shown = axes.imshow(table, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    for row, column in np.argwhere(np.isfinite(table)):
        value = table[row, column]
        if abs(value) >= 0.005:
            text = f"{value:+.2f}".replace("-", MINUS)
            pale = "white" if abs(value) > 0.6 else "black"
            axes.text(column, row, text, ha="center", va="center", fontsize=SMALL - 1, color=pale)
    axes.set_facecolor("0.93")
    labels = []
    for found in arrangements:
        spread = float(found.spread[0])
        labels.append(
            f"{_label(found)}\nσ = {spread:.2g}" if spread < UNSEEN else f"{_label(found)}\n∞"
        )
    axes.set_yticks(range(len(labels)), labels, fontsize=SMALL)
    axes.set_xticks(
        range(len(names)),
        [parameter_label(n).replace(" ", "\n", 1) for n in names],
        fontsize=SMALL - 1,
    )
    axes.set_xlabel("parts of the eigenvector of largest variance (no unit)", fontsize=SMALL + 1)
    bar = figure.colorbar(shown, ax=axes, pad=0.01)
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label("part (no unit)", fontsize=SMALL)


def _corner_of_bounds(found: Arrangement, name: str) -> Figure:
    units = found.pose.units
    values = torch.tensor(list(found.pose.file_values().values()), dtype=torch.float64)
    return corner_figure(
        found.information.covariance / torch.outer(units, units),
        [parameter_label(name) for name in found.pose.names],
        found.pose.unit_names,
        values,
        found.estimates,
        values if found.estimates is not None else None,
        f"{name}\n{_label(found)}: Cramér–Rao bounds",
    )


def _unit(unit: str) -> str:
    return "°" if unit == "deg" else f" {unit}"


def _label(found: Arrangement) -> str:
    return found.name.replace("_", " ")


def _names(arrangements: Sequence[Arrangement]) -> list[str]:
    """Return the names of all variables of all arrangements."""
    return list(dict.fromkeys(name for f in arrangements for name in f.pose.names))


def _coloured(arrangements: Sequence[Arrangement]) -> zip:
    return zip(arrangements, colours(len(arrangements)), strict=True)
