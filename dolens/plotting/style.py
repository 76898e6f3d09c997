"""Colours and text sizes that all figures share."""

from itertools import cycle, islice

from matplotlib.axes import Axes

# Okabe and Ito's colours, told apart by colour-blind readers too; yellow is too pale for lines.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
SMALL = 8
TITLE = 10


def colours(count: int) -> list[str]:
    """That many line colours; they repeat after seven."""
    return list(islice(cycle(PALETTE), count))


def open_axes(axes: Axes) -> None:
    """Leave only the left and bottom spines, and make the numbers small."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=SMALL)
