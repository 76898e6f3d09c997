"""Titles are broken into lines where they are wider than their figure."""

import re

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from dolens.plotting.style import TITLE

# The share of a figure's width that titles may take.  Those of axes stand over the axes' middle,
# which labels at the left push aside.
_ROOM, _ROOM_OVER_AXES = 0.98, 0.82
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
        added = _fit(figure.suptitle(text, fontsize=size), _ROOM * figure.bbox.width)
        _grow(figure, added, size)


def draw_axes_title(axes: Axes, text: str | None, size: float = TITLE) -> None:
    """Write a title above axes that fill their figure's width, as `draw_title` does."""
    if text:
        figure = axes.get_figure(root=True)
        assert figure is not None  # axes are drawn in one
        added = _fit(axes.set_title(text, fontsize=size), _ROOM_OVER_AXES * figure.bbox.width)
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
