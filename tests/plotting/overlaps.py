"""What a reader of a figure must not find, measured in display coordinates.

`flaws(figure)` lists texts that cover one another or data, texts cut at the figure's edge, axes
whose quantity or unit is not named, and hyphens that stand for a minus.
"""

import re
from itertools import combinations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

# Pixels: letters may come so near.
_SLACK = 1.0
# In mathematical text a hyphen is drawn as a minus.
_HYPHEN = re.compile(r"^[^$]*(?<![\w)×$])-(?=[\d.])")
_UNITS = re.compile(r"\(.*\)|/ semi-diameter|iteration|eigenvector|photons|rays|damping|merit")


def flaws(figure, images_hold_text=False):
    """Return a sentence for each flaw of a figure.

    Args:
        figure: any.
        images_hold_text: numbers in the cells of a matrix are meant to lie on it.
    """
    FigureCanvasAgg(figure).draw()
    texts = shown_texts(figure)
    found = [f"'{_of(text)}' is cut" for text, box in texts if not _within(box, figure.bbox)]
    for (one, box), (other, another) in combinations(texts, 2):
        if _shared(box, another):
            found.append(f"'{_of(one)}' covers '{_of(other)}'")
    for axes in visible_axes(figure):
        points = drawn_points(axes)
        for text, box in texts:
            covered = _inside(points, box)
            if covered:
                found.append(f"'{_of(text)}' covers {covered} points of data")
        if axes.images and not images_hold_text:
            frame = axes.get_window_extent()
            inside = [_of(t) for t, box in texts if _shared(box, frame)]
            found += [f"'{text}' covers an image" for text in inside]
        found += [f"axis without a quantity and unit: '{label}'" for label in unnamed(axes)]
    found += [f"a hyphen for a minus: '{_of(t)}'" for t, _ in texts if _HYPHEN.search(_of(t))]
    return found


def shown_texts(figure):
    """Return all texts that are drawn, with their boxes in pixels."""
    renderer = figure.canvas.get_renderer()
    hidden = _hidden_ticks(figure)
    hidden |= {
        id(text) for axes in figure.axes if not axes.get_visible() for text in axes.findobj(Text)
    }
    return [
        # Of an annotation's text, without its line.
        (text, Text.get_window_extent(text, renderer))
        for text in figure.findobj(Text)
        if text.get_visible() and _of(text).strip() and id(text) not in hidden
    ]


def visible_axes(figure):
    return [axes for axes in figure.axes if axes.get_visible()]


def drawn_points(axes):
    """Return markers and densely sampled lines in pixels, (N, 2), clipped to the axes."""
    found = [np.zeros((0, 2))]
    for line in axes.get_lines():
        if not line.get_visible() or line.get_transform() != axes.transData:
            continue
        places = axes.transData.transform(line.get_path().vertices)
        places = places[np.isfinite(places).all(1)]
        has_line = line.get_linestyle() not in ("None", "none", "", " ")
        if line.get_marker() not in ("None", None, "") or has_line:
            found.append(places)
        if has_line and len(places) > 1:
            share = np.linspace(0.0, 1.0, 50)[:, None, None]
            found.append((places[:-1] * (1.0 - share) + places[1:] * share).reshape(-1, 2))
    for drawn in axes.collections:
        offsets = np.asarray(drawn.get_offsets(), dtype=float).reshape(-1, 2)
        if len(drawn.get_offsets()) and drawn.get_visible():
            found.append(drawn.get_offset_transform().transform(offsets))
    points = np.concatenate(found)
    return points[_mask(points, axes.get_window_extent())]


def unnamed(axes):
    """Return labels of axes with numbers that name no quantity or no unit."""
    missing = []
    shared = (
        axes.get_shared_x_axes().get_siblings(axes),
        axes.get_shared_y_axes().get_siblings(axes),
    )
    for axis, others in ((axes.xaxis, shared[0]), (axes.yaxis, shared[1])):
        own = [tick for tick in axis.get_ticklabels() if tick.get_visible() and tick.get_text()]
        numbers = [t for t in own if re.fullmatch(r"[−\d.×⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+|\$.*\$", t.get_text())]
        if not numbers or axes.images:
            continue
        name = "xaxis" if axis is axes.xaxis else "yaxis"
        labels = [getattr(other, name).get_label_text() for other in (*others, *_row(axes, name))]
        if not any(_UNITS.search(label) for label in labels):
            missing.append(axis.get_label_text())
    return missing


def _row(axes, name):
    """Return the first axes of the same row, whose label stands for all; none for columns."""
    place = axes.get_subplotspec()
    if name == "xaxis" or place is None:
        return []
    rows = place.rowspan.start
    return [
        other
        for other in axes.figure.axes
        if (spec := other.get_subplotspec()) is not None
        and spec.get_gridspec() is place.get_gridspec()
        and (spec.rowspan.start, spec.colspan.start) == (rows, 0)
    ]


def _hidden_ticks(figure):
    """Return the labels of ticks that lie beyond the limits of their axes, by id."""
    hidden = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            shown = {id(tick) for tick in axis._update_ticks()} if axes.get_visible() else set()
            for tick in (*axis.majorTicks, *axis.minorTicks):
                if id(tick) not in shown:
                    hidden |= {id(tick.label1), id(tick.label2)}
    return hidden


def _of(text):
    return text.get_text()


def _within(box, frame):
    return (
        box.x0 >= frame.x0 - _SLACK
        and box.y0 >= frame.y0 - _SLACK
        and box.x1 <= frame.x1 + _SLACK
        and box.y1 <= frame.y1 + _SLACK
    )


def _shared(one, other):
    across = min(one.x1, other.x1) - max(one.x0, other.x0)
    up = min(one.y1, other.y1) - max(one.y0, other.y0)
    return across > _SLACK and up > _SLACK


def _inside(points, box):
    return int(_mask(points, box.padded(-_SLACK)).sum())


def _mask(points, box):
    x, y = points.T if len(points) else (np.zeros(0), np.zeros(0))
    return (x > box.x0) & (x < box.x1) & (y > box.y0) & (y < box.y1)
