"""Legends below a figure have as many columns as the figure is wide enough for."""

from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from dolens.plotting.style import SMALL

# The share of a figure's width that a legend may take.
_ROOM = 0.98


def legend_below(
    figure: Figure,
    handles: Sequence[Artist],
    columns: int,
    labels: Sequence[str] | None = None,
    marker_scale: float = 1.0,
) -> Legend:
    """Draw a legend below all axes, with fewer columns than asked for where it would be cut.

    Args:
        figure: of its final width.
        handles: of the entries.
        columns: at most.
        labels: of the entries; None: the handles' own.
        marker_scale: of markers, over those in the axes.
    """
    names = [str(handle.get_label()) for handle in handles] if labels is None else list(labels)
    while True:
        legend = figure.legend(
            list(handles),
            names,
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=SMALL,
            markerscale=marker_scale,
        )
        fits = legend.get_window_extent().width <= _ROOM * figure.bbox.width
        if fits or columns <= 1:
            return legend
        legend.remove()
        columns -= 1
