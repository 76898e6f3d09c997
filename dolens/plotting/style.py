"""Colours and text sizes that all figures share."""

from itertools import cycle, islice

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex

# Okabe and Ito's colours, told apart by colour-blind readers too; yellow is too pale for lines.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
SMALL = 8
TITLE = 10


def colours(count: int) -> list[str]:
    """That many line colours; they repeat after seven."""
    return list(islice(cycle(PALETTE), count))


def spectral_colour(wavelength: float) -> str:
    """A line colour that says which wavelength (nm), from violet at 400 to red at 700."""
    share = (wavelength - 400.0) / 300.0
    return to_hex(colormaps["turbo"](min(max(share, 0.05), 0.95)))


def open_axes(axes: Axes) -> None:
    """Leave only the left and bottom spines, and make the numbers small."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=SMALL)
