"""Curves over one axis: training histories, responses over depth."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dolens.errors import InputError
from dolens.plotting.style import SMALL, TITLE, colours, open_axes

# Up to here each sample is worth a dot.
_FEW = 20


def curves_figure(
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    xlabel: str,
    ylabel: str,
    title: str | None = None,
    logy: bool = False,
) -> Figure:
    """Lines in one pair of axes.

    Args:
        series: label → (x, y), of one length each; units are in the axes' labels.
        xlabel: with its unit.
        ylabel: with its unit.
        title: above the axes.
        logy: whether y is logarithmic; values that are not positive then leave gaps.

    Returns:
        A figure; the legend is left out where there is one line only.
    """
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for (label, (x, y)), colour in zip(series.items(), colours(len(series)), strict=True):
        if len(x) != len(y):
            raise InputError(f"series '{label}': {len(x)} values of x and {len(y)} of y")
        marker = "o" if len(x) <= _FEW else None
        axes.plot(x, y, label=label, color=colour, linewidth=1.4, marker=marker, markersize=3.5)
    if all(float(value).is_integer() for x, _ in series.values() for value in x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if logy:
        axes.set_yscale("log", nonpositive="mask")
    axes.set_xlabel(xlabel, fontsize=SMALL + 1)
    axes.set_ylabel(ylabel, fontsize=SMALL + 1)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    open_axes(axes)
    if len(series) > 1:
        axes.legend(frameon=False, fontsize=SMALL)
    if title:
        axes.set_title(title, fontsize=TITLE)
    return figure
