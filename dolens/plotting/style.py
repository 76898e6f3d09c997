"""All figures share this style: colours, widths, numbers, titles, captions, legends, ticks,
scale bars.
"""

import math
import re
import textwrap
from collections.abc import Sequence
from itertools import cycle, islice
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order

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


MINUS = "\N{MINUS SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# A hyphen that stands before a number and not within a word or between two numbers.
_HYPHEN = re.compile(r"(?<![\w)])-(?=[\d.∞])")


def with_minus(text: str) -> str:
    """Return a text whose hyphens before numbers are minus signs (U+2212)."""
    return _HYPHEN.sub(MINUS, text)


def number_text(value: float, digits: int = 3) -> str:
    """Return a number of so many significant digits: `0.0123`, `−4.5`, `4×10⁶`.

    Powers of ten are written where the number is below 0.001 or has more digits before the point
    than are asked for, and more than five.
    """
    if not math.isfinite(value):
        return "∞" if value > 0.0 else (f"{MINUS}∞" if value < 0.0 else "–")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if value == 0.0 or -4 < power < max(digits, 5):
        decimals = max(digits - 1 - power, 0) if value else 0
        rounded = float(f"{value:.{digits - 1}e}")
        text = f"{rounded:.{decimals}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
        return with_minus(text)
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    tens = "10" + str(power).translate(_SUPERSCRIPTS)
    if mantissa in ("1", "-1"):
        return with_minus(mantissa)[:-1] + tens
    return with_minus(f"{mantissa}×{tens}")


def value_and_error(value: float, sigma: float) -> tuple[str, str]:
    """Return a value with the digits that its standard deviation allows, and the deviation.

    The deviation has one significant digit, or two where the first is a 1: `−667` and `3` of
    −666.725 and 3.3.

    Args:
        value: finite.
        sigma: positive and finite.
    """
    first, power = f"{sigma:.1e}"[0], int(f"{sigma:.0e}".split("e")[1])
    power -= first == "1"
    shown, error = (f"{round(number, -power):.{max(-power, 0)}f}" for number in (value, sigma))
    # No negative zero.
    shown = shown.removeprefix("-") if float(shown) == 0.0 else shown
    return with_minus(shown), error


# The share of a figure's width that titles and legends may take.  Titles of axes stand over the
# middle of these, which labels at the left push aside.
_FIGURE_SHARE, _AXES_TITLE_SHARE = 0.98, 0.82
# Height of a line over the size of its text.
_LEADING = 1.3
_POINTS_PER_INCH = 72.0
# After a colon; else after a semicolon or a comma; else between words, but not about an equals sign
# nor before a unit.  The longest first line that fits is taken.
_BREAKS = (r"(?<=:)\s", r"(?<=[;,])\s", r"(?<!=)\s(?!=|[a-zµ]{1,2}\b)", r"\s")


def draw_title(figure: Figure, text: str | None, size: float = TITLE) -> None:
    """Write a title above all axes; the figure grows by the lines that are added.

    Args:
        figure: of its final width.
        text: one line or several; empty or None for no title.
        size: of the text, points of 1/72 inch.
    """
    if text:
        added = _fit(figure.suptitle(text, fontsize=size), _FIGURE_SHARE * figure.bbox.width)
        _grow(figure, added, size)


def draw_note(figure: Figure, text: str) -> None:
    """Write how things are shown below all axes, small; the figure grows by its lines."""
    # A letter is half as wide as the text is high.
    letters = int(_FIGURE_SHARE * figure.get_figwidth() * _POINTS_PER_INCH / (0.5 * SMALL))
    lines = textwrap.wrap(text, letters)
    figure.supxlabel("\n".join(lines), fontsize=SMALL, color="0.25")
    _grow(figure, len(lines), SMALL)


def draw_axes_title(axes: Axes, text: str | None, size: float = TITLE) -> None:
    """Write a title above axes that fill their figure's width, as `draw_title` does."""
    if text:
        figure = axes.get_figure(root=True)
        assert figure is not None  # axes are drawn in one
        added = _fit(axes.set_title(text, fontsize=size), _AXES_TITLE_SHARE * figure.bbox.width)
        _grow(figure, added, size)


def _grow(figure: Figure, lines: int, size: float) -> None:
    if lines:
        figure.set_figheight(figure.get_figheight() + lines * _LEADING * size / _POINTS_PER_INCH)


def _fit(title: Text, room: float) -> int:
    """Break a title into lines that are no wider than the room (pixels); return how many it adds.

    A single word that is wider stays whole.
    """
    before = title.get_text().split("\n")
    after = [piece for line in before for piece in _pieces(title, line, room)]
    title.set_text("\n".join(after))
    return len(after) - len(before)


def _pieces(title: Text, line: str, room: float) -> list[str]:
    if _width(title, line) <= room:
        return [line]
    for pattern in _BREAKS:
        for place in reversed(list(re.finditer(pattern, line))):
            if _width(title, line[: place.start()]) <= room:
                return [line[: place.start()], *_pieces(title, line[place.end() :], room)]
    first, _, rest = line.partition(" ")
    return [first, *_pieces(title, rest, room)] if rest else [first]


def _width(title: Text, line: str) -> float:
    title.set_text(line)
    return title.get_window_extent().width


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
        fits = legend.get_window_extent().width <= _FIGURE_SHARE * figure.bbox.width
        if fits or columns <= 1:
            return legend
        legend.remove()
        columns -= 1


_FEW_DECADES, _MANY = 2.5, 7.0
_STEPS = {1.2: (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0), _FEW_DECADES: (1.0, 2.0, 5.0)}


def log_ticks(axis: Axis, most: int = 8) -> None:
    """Put ticks on a logarithmic axis whose limits are final: 1, 2, 5, or whole decades.

    Numbers are plain where an axis covers few decades, and powers of ten where it covers many.
    An axis within a decade keeps at least two numbers.

    Args:
        axis: x or y.
        most: numbers that it has room for.
    """
    low, high = sorted(axis.get_view_interval())
    if not 0.0 < low < high:
        return
    decades = math.log10(high / low)
    if decades > _FEW_DECADES:
        stride = math.ceil(decades / _MANY)
        axis.set_major_locator(LogLocator(base=10.0**stride, numticks=99))
        minors = tuple(range(2, 10)) if stride == 1 and decades < _MANY else (1.0,)
        axis.set_minor_locator(LogLocator(base=10.0, subs=minors, numticks=99))
        axis.set_minor_formatter(NullFormatter())
        if low >= 1e-3 and high <= 1e4:
            axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value)))
        return
    steps = next(found for most, found in _STEPS.items() if decades <= most)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    places = [step * 10.0**power for power in range(first, last + 1) for step in steps]
    inside = [place for place in places if low * 0.9999 <= place <= high * 1.0001]
    if len(inside) < 2:
        inside = _evenly(low, high)
    while len(inside) > most:
        inside = inside[::2]
    axis.set_major_locator(FixedLocator(inside))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value, 4)))
    axis.set_minor_locator(NullLocator())


def _evenly(low: float, high: float) -> list[float]:
    """Return round numbers between two that are close together."""
    step = 10.0 ** math.floor(math.log10(high - low))
    for factor in (1.0, 0.5, 0.2):
        first = math.ceil(low / (factor * step))
        found = [n * factor * step for n in range(first, math.floor(high / (factor * step)) + 1)]
        if len(found) >= 3:
            break
    return found


_LONGEST = 0.45


def round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a length."""
    lengths = [factor * 10.0**power for power in range(-9, 7) for factor in (1.0, 2.0, 5.0)]
    return max((length for length in lengths if length <= longest * (1.0 + 1e-9)), default=longest)


def scale_bar(axes: Axes, pixels: int, pitch: float) -> None:
    """Draw a bar of a round length below an image, at its left, where it covers nothing.

    Artists carry gids: `scale bar`, `scale`.

    Args:
        axes: with an image of square pixels.
        pixels: shown across it.
        pitch: mm, of a pixel.
    """
    length = round_length(_LONGEST * pixels * pitch)
    share = length / (pixels * pitch)
    look: dict[str, Any] = {
        "color": "black",
        "linewidth": 2.0,
        "solid_capstyle": "butt",
        "clip_on": False,
    }
    axes.plot([0.0, share], [-0.05, -0.05], transform=axes.transAxes, gid="scale bar", **look)
    text = f"{number_text(length)} mm" if length >= 0.1 else f"{number_text(1e3 * length)} µm"
    count = length / pitch
    text += f" ({number_text(count)} px)" if abs(count - round(count)) < 1e-6 else ""
    axes.text(
        0.0,
        -0.08,
        text,
        transform=axes.transAxes,
        ha="left",
        va="top",
        fontsize=SMALL - 1,
        gid="scale",
    )


# Longer names of lenses are cut; lines of a caption fit over a narrow figure.
_LONGEST_NAME, _LINE_OF_CAPTION = 50, 52


@torch.no_grad()
def caption(what: str, lens: Lens, where: Conditions) -> str:
    """Return a title such as `Spot diagram: Cooke triplet, F/4.93, 587.6 nm`; lines break where
    one is too long for a narrow figure.

    Args:
        what: the figure shows.
        lens: the lens; its F-number is the paraxial one of its stop at the reference wavelength, in
            the y-z section.
        where: wavelengths and object distance; of a near object the working F-number and the
            distance are named.
    """
    object_distance = where.object_distance
    first = first_order(lens.system().section("y"), where.reference_wavelength, object_distance)
    number = abs(float(first.working_f_number))
    parts = []
    if math.isfinite(number):
        working = "" if object_distance is None else "working "
        parts.append(f"{working}F/{number:.3g}")
    parts.append(wavelengths_text(where.wavelengths))
    if object_distance is not None:
        parts.append(f"object at {object_distance:g} mm")
    name = [f"{plain_text(lens.name)},"] if lens.name else []
    lines = [f"{what}:"]
    for piece in (*name, ", ".join(parts)):
        longer = f"{lines[-1]} {piece}"
        lines[-1:] = [longer] if len(longer) <= _LINE_OF_CAPTION else [lines[-1], piece]
    return "\n".join(lines)


def wavelengths_text(wavelengths: Sequence[float] | Tensor) -> str:
    """Return `587.6 nm`, or the range of several wavelengths and their number."""
    waves = sorted({float(wave) for wave in wavelengths})
    if len(waves) == 1:
        return f"{waves[0]:.4g} nm"
    if len(waves) <= 3:
        return f"{', '.join(f'{wave:.4g}' for wave in waves)} nm"
    return f"{len(waves)} wavelengths from {waves[0]:.4g} to {waves[-1]:.4g} nm"


def plain_text(text: str) -> str:
    """Return text that a figure shows as it is, without formulas, on one line, cut when long."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    text = text if len(text) <= _LONGEST_NAME else text[: _LONGEST_NAME - 1] + "…"
    return text.replace("$", r"\$")
