"""A map of the starts of a search shows which of them led to which form, and how many did."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dolens.errors import InputError
from dolens.plotting.style import MARKERS, PAGE, PALETTE, SMALL, open_axes, ruled_axes
from dolens.plotting.titles import draw_title

# Forms with a colour of their own; the others share one.
_OWN = len(PALETTE) - 1
_OTHERS, _NONE = "0.68", "0.87"
# The span of the map: this share of the points, so that a few strays do not squeeze all others.
_SHARE, _ROOM = 0.99, 0.12


def starts_figure(
    points: np.ndarray,
    forms: Sequence[int],
    axes_labels: tuple[str, str],
    tried: int | None = None,
    title: str | None = None,
) -> Figure:
    """Plot which start led where.

    Args:
        points: (N, 2), coordinates of the starts.
        forms: (N,), number of the form that each reached, from 0, the best; -1 where it led to
            none.
        axes_labels: of the coordinates.
        tried: how many starts there were, where only some are given; the others led nowhere.
        title: above all.

    Raises:
        InputError: there are no points, or not as many as forms.
    """
    points, reached = np.asarray(points, dtype=float), np.asarray(forms, dtype=int)
    if points.shape != (len(reached), 2) or not len(reached):
        raise InputError(
            f"starts: {points.shape} coordinates of {len(reached)} forms; allowed: two of each"
        )
    figure = Figure(figsize=(PAGE, 4.1), layout="constrained")
    plane, bars = figure.subplots(1, 2, width_ratios=(2.5, 1.0))
    _draw_map(plane, points, reached, axes_labels)
    _draw_counts(bars, reached, len(reached) if tried is None else tried)
    draw_title(figure, title)
    return figure


def _look(form: int) -> tuple[str, str]:
    """Return colour and marker of a form."""
    if form < 0:
        return _NONE, "."
    return (PALETTE[form], MARKERS[form]) if form < _OWN else (_OTHERS, "o")


def _draw_map(axes: Axes, points: np.ndarray, reached: np.ndarray, labels: tuple[str, str]) -> None:
    limits = []
    for values in points.T:
        low, high = np.quantile(values, [0.5 * (1.0 - _SHARE), 0.5 * (1.0 + _SHARE)])
        room = _ROOM * max(high - low, 1e-12)
        limits.append((low - room, high + room))
    lows, highs = np.array(limits).T
    inside = ((points > lows) & (points < highs)).all(1)
    # The best forms lie on top, and what led nowhere below all.
    for form in (-1, *range(_OWN, -1, -1)):
        chosen = inside & (reached >= _OWN if form == _OWN else reached == form)
        colour, marker = _look(form)
        size = 20.0 if 0 <= form < _OWN else 7.0
        x, y = points[chosen].T
        axes.scatter(x, y, s=size, color=colour, marker=marker, linewidths=0.0, clip_on=False)
    axes.set(xlim=limits[0], ylim=limits[1])
    outside = int((~inside).sum())
    if outside:
        text = f"{outside} start{'s' * (outside > 1)} farther out"
        axes.set_title(text, fontsize=SMALL - 1, color="0.4", loc="right", pad=3.0)
    axes.set_xlabel(labels[0], fontsize=SMALL + 1)
    axes.set_ylabel(labels[1], fontsize=SMALL + 1)
    ruled_axes(axes)


def _draw_counts(axes: Axes, reached: np.ndarray, tried: int) -> None:
    """Draw a bar for each form, as long as the starts that led there."""
    own = [n for n in range(_OWN) if bool((reached == n).any())]
    rows = [(f"form {n + 1}", int((reached == n).sum()), n) for n in own]
    longest = max((count for _, count, _ in rows), default=1)
    others = reached[reached >= _OWN]
    if len(others):
        kinds = len(set(others.tolist()))
        rows.append((f"{kinds} other{'s' * (kinds > 1)}", len(others), _OWN))
    rows.append(("no design", tried - int((reached >= 0).sum()), -1))
    for place, (_, count, form) in enumerate(rows):
        colour, marker = _look(form)
        # What led elsewhere dwarfs the rest: its bar is cut, and its number says how long it is.
        length = min(count, 1.18 * longest)
        axes.barh(place, length, height=0.62, color=colour)
        if count > length:
            cut = 0.9 * longest * np.ones(2)
            axes.plot(cut, [place - 0.36, place + 0.36], color="white", linewidth=2.5)
        axes.text(length + 0.04 * longest, place, f"{count}", fontsize=SMALL, va="center")
        axes.plot(-0.07 * longest, place, marker=marker, color=colour, markersize=5, clip_on=False)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows], fontsize=SMALL)
    axes.tick_params(axis="y", length=0, pad=14)
    axes.set_xlim(0.0, 1.55 * longest)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=4))
    axes.set_xlabel("starts (number)", fontsize=SMALL + 1)
    open_axes(axes)
    axes.spines["left"].set_visible(False)
