"""Labels of points are put where they cover neither points nor one another."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox

# Where a label may stand about its point: direction, nearest first, at these distances in points.
_DISTANCES = (5.0, 11.0, 18.0, 27.0, 38.0)
_DIRECTIONS = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
_ALIGNED = {1: ("left", "bottom"), 0: ("center", "center"), -1: ("right", "top")}
# Half the size of a marker, and the gap between texts, points of 1/72 inch.
_MARKER, _GAP = 4.0, 1.5


def place_labels(axes: Axes, labels: Sequence[tuple[str, float, float, str]], size: float) -> None:
    """Write labels beside their points, within the axes, without covering anything drawn there.

    The limits of the axes must be final, and everything else drawn.  A label far from its point
    gets a thin line to it.  Where there is no free place, the least covered one is taken.

    Args:
        axes: with points and lines; its figure lays itself out once.
        labels: text, x and y of the point, colour.
        size: of the text, points.
    """
    figure = axes.get_figure()
    figure.draw_without_rendering()
    scale = figure.dpi / 72.0
    frame = axes.get_window_extent()
    taken = [_box(point, _MARKER * scale) for point in _drawn_points(axes)]
    taken += [text.get_window_extent() for text in axes.texts if text.get_text()]
    if axes.get_legend() is not None:
        taken.append(axes.get_legend().get_window_extent())
    for text, x, y, colour in labels:
        best, least = None, np.inf
        for distance in _DISTANCES:
            for direction in _DIRECTIONS:
                candidate = _label(axes, text, (x, y), direction, distance, colour, size)
                box = candidate.get_window_extent().padded(_GAP * scale)
                candidate.remove()
                cost = sum(_shared(box, other) for other in taken) + _outside(box, frame)
                if cost < least:
                    best, least = (direction, distance, box), cost
                if cost == 0.0:
                    break
            if least == 0.0:
                break
        direction, distance, box = best
        placed = _label(axes, text, (x, y), direction, distance, colour, size)
        if distance > _DISTANCES[1]:
            placed.arrow_patch.set_visible(True)
        taken.append(box)


def _label(
    axes: Axes,
    text: str,
    point: tuple[float, float],
    direction: tuple[int, int],
    distance: float,
    colour: str,
    size: float,
) -> Annotation:
    length = np.hypot(*direction)
    offset = [distance * step / length for step in direction]
    label = axes.annotate(
        text,
        point,
        xytext=offset,
        textcoords="offset points",
        ha=_ALIGNED[direction[0]][0],
        va=_ALIGNED[direction[1]][1],
        fontsize=size,
        color=colour,
        arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.5, "shrinkB": 3.0},
    )
    label.arrow_patch.set_visible(False)
    label.set_in_layout(False)
    return label


def _drawn_points(axes: Axes) -> np.ndarray:
    """Return everything drawn as points, pixels, (N, 2): markers, and lines at small steps."""
    found = []
    for line in axes.get_lines():
        if line.get_xdata(orig=True) is not None and line.get_transform() == axes.transData:
            places = axes.transData.transform(np.column_stack(line.get_data()))
            places = places[np.isfinite(places).all(1)]
            found.append(places)
            if line.get_linestyle() not in ("None", "none", "", " ") and len(places) > 1:
                share = np.linspace(0.0, 1.0, 60)[:, None, None]
                between = places[:-1] * (1.0 - share) + places[1:] * share
                found.append(between.reshape(-1, 2))
    found += [
        axes.transData.transform(np.asarray(drawn.get_offsets()).reshape(-1, 2))
        for drawn in axes.collections
        if len(drawn.get_offsets())
    ]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _box(point: np.ndarray, half: float) -> Bbox:
    return Bbox.from_extents(*(point - half), *(point + half))


def _shared(one: Bbox, other: Bbox) -> float:
    """Return the area that two boxes share, pixels."""
    across = min(one.x1, other.x1) - max(one.x0, other.x0)
    up = min(one.y1, other.y1) - max(one.y0, other.y0)
    return across * up if across > 0.0 and up > 0.0 else 0.0


def _outside(box: Bbox, frame: Bbox) -> float:
    """Return the area of a box outside of the frame, pixels; it counts twice."""
    return 2.0 * (box.width * box.height - _shared(box, frame))


def figure_of(axes: Axes) -> Figure:
    """Return the figure that axes lie in, whatever subfigures there are between."""
    return axes.get_figure(root=True)
