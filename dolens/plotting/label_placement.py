"""Labels of points are put where they cover neither points nor one another."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Text

# Where a label may stand about its point: direction, and distance in points of 1/72 inch, the
# nearest first.
_DISTANCES = (5.0, 11.0, 18.0, 27.0, 38.0)
_DIRECTIONS = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
_PLACES = np.array([(d * x, d * y) for d in _DISTANCES for x, y in _DIRECTIONS])
# A label farther out than this gets a line to its point.
_NEAR = 11.0
# Half the size of a marker, and the gap between texts.
_MARKER, _GAP = 4.0, 1.5
# Steps along a line between two of its points.
_STEPS = 40


def place_labels(axes: Axes, labels: Sequence[tuple[str, float, float, str]], size: float) -> None:
    """Write labels beside their points, within the axes, without covering anything drawn there.

    The limits of the axes must be final, and everything else drawn.  A label far from its point
    gets a thin line to it.  Where there is no free place, the least covered one is taken.

    Args:
        axes: with points and lines; its figure lays itself out once.
        labels: text, x and y of the point, colour.
        size: of the text, points of 1/72 inch.
    """
    if not labels:
        return
    figure = axes.get_figure(root=True)
    assert figure is not None  # axes are drawn in one
    figure.draw_without_rendering()
    scale = figure.dpi / 72.0
    frame = np.array(axes.get_window_extent().extents)
    drawn = _drawn_points(axes)
    half = _MARKER * scale
    taken = np.concatenate([drawn - half, drawn + half], 1)
    texts = [t.get_window_extent().extents for t in axes.texts if t.get_text()]
    legend = axes.get_legend()
    if legend is not None:
        texts.append(legend.get_window_extent().extents)
    labels_taken = np.array(texts).reshape(-1, 4)
    taken = np.concatenate([taken, labels_taken])
    for text, x, y, colour in labels:
        note = axes.annotate(
            text,
            (x, y),
            xytext=(0.0, 0.0),
            textcoords="offset points",
            fontsize=size,
            color=colour,
            ha="center",
            va="center",
            arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.5, "shrinkB": 3.0},
        )
        note.set_in_layout(False)
        # Of the text without its line.
        extent = Text.get_window_extent(note)
        reach = 0.5 * np.array([extent.width, extent.height])
        # The text's centre, so far off that its nearest corner or side is at the wanted distance.
        centres = _PLACES * scale + np.sign(_PLACES) * reach
        point = axes.transData.transform((x, y))
        gap = reach + _GAP * scale
        boxes = np.concatenate([point + centres - gap, point + centres + gap], 1)
        outside = np.prod(2.0 * gap) - _shared(boxes, frame[None])[:, 0]
        # A line to the point is thin, but it must not run through another label either.
        lines = point + centres[:, None] * np.linspace(0.2, 1.0, _STEPS)[:, None]
        far = np.abs(_PLACES).max(1) > _NEAR
        along = np.concatenate([lines - half, lines + half], 2)
        crossed = _shared(along.reshape(-1, 4), labels_taken).reshape(len(far), -1).sum(1)
        cost = _shared(boxes, taken).sum(1) + 2.0 * outside + far * crossed
        best = int(cost.argmin())
        note.set_position(tuple(centres[best] / scale))
        assert note.arrow_patch is not None  # it was asked for
        note.arrow_patch.set_visible(bool(far[best]))
        labels_taken = np.concatenate([labels_taken, boxes[[best]]])
        taken = np.concatenate([taken, boxes[[best]]] + ([along[best]] if far[best] else []))


def _drawn_points(axes: Axes) -> np.ndarray:
    """Return everything drawn as points, pixels, (N, 2): markers, and lines at small steps."""
    found = [np.zeros((0, 2))]
    share = np.linspace(0.0, 1.0, _STEPS)[:, None, None]
    for line in axes.get_lines():
        # Its own transform: a line across the whole axes counts its ends from their sides.
        places = line.get_transform().transform(line.get_path().vertices)
        places = places[np.isfinite(places).all(1)]
        found.append(places)
        if line.get_linestyle() not in ("None", "none", "", " ") and len(places) > 1:
            found.append((places[:-1] * (1.0 - share) + places[1:] * share).reshape(-1, 2))
    for drawn in axes.collections:
        offsets = np.asarray(drawn.get_offsets(), dtype=float).reshape(-1, 2)
        found.append(axes.transData.transform(offsets))
    return np.concatenate(found)


def _shared(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the areas that boxes (A, 4) share with others (B, 4), as x0 y0 x1 y1: (A, B)."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return (high - low).clip(min=0.0).prod(-1)
