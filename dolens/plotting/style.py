"""All figures share widths, colours, line styles and text sizes."""

from collections.abc import Sequence
from itertools import cycle, islice
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.lines import Line2D
from torch import Tensor

# Okabe and Ito's colours, told apart by colour-blind readers too; yellow is too pale for lines.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
# Lines of one figure differ in these too, so that they are told apart in grey.
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5)))
MARKERS = "osD^vP*X"
SMALL = 8
TITLE = 10
# Inches: a page of two columns, as most journals print it.  Figures are this wide or less, so that
# the text sizes above are those on paper.
PAGE = 7.2

# Violet, blue, green, amber, vermilion, dark red: dark enough for lines on white, and told apart by
# colour-blind readers.
_SPECTRUM = {
    400.0: "#5B2C83",
    486.0: "#0072B2",
    546.0: "#00875F",
    588.0: "#C68400",
    656.0: "#CC3300",
    700.0: "#701A00",
}
# The light end of the colour map would be lost on white.
_LIGHTEST = 0.86


def colours(count: int) -> list[str]:
    """Return that many line colours; they repeat after seven."""
    return list(islice(cycle(PALETTE), count))


def ordered_colours(count: int) -> list[str]:
    """Return that many colours of an ordered quantity, from dark to light; grey keeps the order."""
    shares = np.linspace(0.0, _LIGHTEST, count) if count > 1 else [0.35]
    return [to_hex(colormaps["viridis"](share)) for share in shares]


def line_styles(count: int) -> list[dict[str, Any]]:
    """Return `color` and `linestyle` of that many lines; no two are alike up to 28."""
    shades = colours(count)
    return [
        {"color": shades[n], "linestyle": DASHES[sum(divmod(n, len(PALETTE))) % len(DASHES)]}
        for n in range(count)
    ]


def spectral_colour(wavelength: float) -> str:
    """Return a line colour for a wavelength (nm), from violet at 400 to dark red at 700."""
    nodes = np.array([to_rgb(colour) for colour in _SPECTRUM.values()])
    red, green, blue = (np.interp(wavelength, list(_SPECTRUM), nodes[:, n]) for n in range(3))
    return to_hex((float(red), float(green), float(blue)))


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
