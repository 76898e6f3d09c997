"""All figures share colours and text sizes."""

from collections.abc import Sequence
from itertools import cycle, islice

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from torch import Tensor

# Okabe and Ito's colours, told apart by colour-blind readers too; yellow is too pale for lines.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
SMALL = 8
TITLE = 10


def colours(count: int) -> list[str]:
    """Return that many line colours; they repeat after seven."""
    return list(islice(cycle(PALETTE), count))


def spectral_colour(wavelength: float) -> str:
    """Return a line colour for a wavelength (nm), from violet at 400 to red at 700."""
    share = (wavelength - 400.0) / 300.0
    return to_hex(colormaps["turbo"](min(max(share, 0.05), 0.95)))


def field_label(field: Sequence[float] | Tensor, unit: str) -> str:
    """Return `14°`, or `(3, 14)°` for a field beside the y-z plane; in mm likewise."""
    x, y = (float(f"{float(value):.6g}") for value in field)
    space = "" if unit == "°" else " "
    label = f"{y:g}{space}{unit}" if x == 0.0 else f"({x:g}, {y:g}){space}{unit}"
    return label.replace("-", "−")


def wavelength_handles(wavelengths: Sequence[float] | Tensor) -> list[Line2D]:
    """Return entries of a legend: lines in the wavelengths' colours, with their nm."""
    return [
        Line2D([], [], color=spectral_colour(float(w)), linewidth=1.4, label=f"{float(w):g} nm")
        for w in wavelengths
    ]


def ruled_axes(axes: Axes) -> None:
    """Draw open axes over a pale grid."""
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    open_axes(axes)


def open_axes(axes: Axes) -> None:
    """Leave only the left and bottom spines, and make the numbers small."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(which="both", labelsize=SMALL)
