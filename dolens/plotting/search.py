"""The course of a design or a search is plotted: merit, trials, best so far, starts and forms."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import (
    LogFormatterMathtext,
    LogLocator,
    MaxNLocator,
    NullLocator,
    ScalarFormatter,
)

from dolens.errors import InputError
from dolens.plotting.pareto import place_labels
from dolens.plotting.style import (
    MARKERS,
    PAGE,
    PALETTE,
    SMALL,
    draw_axes_title,
    draw_title,
    legend_below,
    log_ticks,
    open_axes,
    ruled_axes,
)

_FEW_ITERATIONS = 40
# The height of the merit's axes over that of the damping's.
_MERIT_HEIGHT = 5.0


def history_figure(
    merit: Sequence[float],
    damping: Sequence[float] | None = None,
    iterations: Sequence[float] | None = None,
    title: str | None = "History of the design",
    merit_label: str = "merit",
    damping_label: str = "damping",
) -> Figure:
    """Plot merit against iteration, on a logarithmic axis, with the damping in a strip below.

    Values that are not positive leave gaps.

    Args:
        merit: one value an iteration.
        damping: as many, or None for no axes below.
        iterations: as many; None counts from zero.
        title: above.
        merit_label: of the axis, with its unit.
        damping_label: of the axis below, with its unit.

    Raises:
        InputError: the numbers of values differ.
    """
    numbers = range(len(merit)) if iterations is None else iterations
    for name, values in (("damping", damping), ("iterations", numbers)):
        if values is not None and len(values) != len(merit):
            raise InputError(f"{len(merit)} values of merit and {len(values)} of {name}")
    rows = [(merit_label, merit, PALETTE[0])]
    if damping is not None:
        rows.append((damping_label, damping, "0.45"))
    ratios = (_MERIT_HEIGHT, 1.0)[: len(rows)]
    figure = Figure(figsize=(5.0, 3.2 + 0.6 * (len(rows) - 1)), layout="constrained")
    grid = figure.subplots(len(rows), 1, squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    marker = "o" if len(merit) <= _FEW_ITERATIONS else None
    for axes, (label, values, colour) in zip(grid, rows, strict=True):
        axes.plot(numbers, values, color=colour, linewidth=1.4, marker=marker, markersize=3)
        axes.set_yscale("log", nonpositive="mask")
        axes.set_ylabel(label, fontsize=SMALL + 1)
        ruled_axes(axes)
        log_ticks(axes.yaxis)
    if damping is not None:
        # A strip has room for a few numbers only.
        grid[1].yaxis.set_major_locator(LogLocator(numticks=3))
        grid[1].yaxis.set_minor_locator(NullLocator())
        grid[1].yaxis.set_major_formatter(LogFormatterMathtext())
    grid[-1].set_xlabel("iteration", fontsize=SMALL + 1)
    grid[-1].xaxis.set_major_locator(MaxNLocator(integer=True, steps=(1, 2, 5, 10)))
    figure.align_ylabels()
    draw_axes_title(grid[0], title)
    return figure


# Positive values that span this ratio are drawn on a logarithmic axis.
_DECADES = 30.0
# So many points of a front get their labels.
_FEW_OF_FRONT = 12


class SearchTrial(NamedTuple):
    """A `SearchTrial` is a trial of a search.

    Attributes:
        number: of the trial.
        values: of the objectives; empty where the trial did not come to its end.
        state: `finished`, `pruned` or `failed`.
    """

    number: int
    values: tuple[float, ...]
    state: str = "finished"


def search_history_figure(
    trials: Sequence[SearchTrial], objective: str, maximize: bool, title: str | None = None
) -> Figure:
    """Plot what each trial reached, and the best so far.

    Args:
        trials: with one objective, in their order.
        objective: label of the y axis, with its unit.
        maximize: whether more is better.
        title: above the axes.

    Returns:
        A figure.  Trials that were pruned or failed are marked on the lower edge.
    """
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.add_subplot()
    finished = [trial for trial in trials if trial.values]
    numbers, values = [t.number for t in finished], [t.values[0] for t in finished]
    axes.plot(numbers, values, "o", color=PALETTE[0], markersize=4, label="trials")
    best: list[float] = []
    for value in values:
        best.append(
            value if not best else max(best[-1], value) if maximize else min(best[-1], value)
        )
    if finished:
        last = max(trial.number for trial in trials)
        axes.step(
            [*numbers, last], [*best, best[-1]], where="post", color=PALETTE[1], label="best so far"
        )
    for state, marker in (("pruned", "|"), ("failed", "x")):
        others = [trial.number for trial in trials if trial.state == state]
        if others:
            axes.plot(
                *(others, [0.02] * len(others), marker),
                transform=axes.get_xaxis_transform(),
                color="0.4",
                markersize=7 if marker == "|" else 4,
                label=state,
            )
    _scale(axes.yaxis, axes, values)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("trial", fontsize=SMALL + 1)
    axes.set_ylabel(objective, fontsize=SMALL + 1)
    ruled_axes(axes)
    handles, names = axes.get_legend_handles_labels()
    legend_below(figure, handles, 4, names)
    draw_axes_title(axes, title)
    return figure


def trade_off_figure(
    trials: Sequence[SearchTrial],
    front: Sequence[int],
    objectives: tuple[str, str],
    title: str | None = None,
) -> Figure:
    """Plot two objectives against each other, with the trials that no other one beats in both.

    Args:
        trials: with two objectives.
        front: numbers of the trials that no other one beats.
        objectives: labels of the y and of the x axis, with their units.
        title: above the axes.

    Returns:
        A figure.
    """
    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axes = figure.add_subplot()
    finished = [trial for trial in trials if trial.values]
    best = sorted((t for t in finished if t.number in front), key=lambda t: t.values[1])
    others = [trial for trial in finished if trial.number not in front]
    axes.plot(*_points(others), "o", color="0.6", markersize=4, label="trials")
    axes.plot(
        *(*_points(best), "o-"),
        color=PALETTE[1],
        markersize=5,
        linewidth=0.8,
        label="Pareto front, with the trials' numbers",
    )
    for place, axis in ((0, axes.yaxis), (1, axes.xaxis)):
        _scale(axis, axes, [trial.values[place] for trial in finished])
    axes.margins(0.08)
    axes.set_ylabel(objectives[0], fontsize=SMALL + 1)
    axes.set_xlabel(objectives[1], fontsize=SMALL + 1)
    ruled_axes(axes)
    handles, names = axes.get_legend_handles_labels()
    legend_below(figure, handles, 2, names)
    draw_axes_title(axes, title)
    if len(best) <= _FEW_OF_FRONT:
        labels = [(str(t.number), t.values[1], t.values[0], "black") for t in best]
        place_labels(axes, labels, SMALL - 1)
    return figure


def _points(trials: Sequence[SearchTrial]) -> tuple[list[float], list[float]]:
    return [trial.values[1] for trial in trials], [trial.values[0] for trial in trials]


def _scale(axis: Axis, axes: Axes, values: Sequence[float]) -> None:
    """Make an axis logarithmic where its values are positive and span decades."""
    if values and min(values) > 0.0 and max(values) > _DECADES * min(values):
        set_scale = axes.set_xscale if axis is axes.xaxis else axes.set_yscale
        set_scale("log")
        log_ticks(axis)
    else:
        formatter = axis.get_major_formatter()
        if isinstance(formatter, ScalarFormatter):
            formatter.set_useOffset(False)


# Merits that span this ratio are drawn on a logarithmic axis.
_WIDE = 3.0
# Designs beyond this many times the best are no part of the picture.
_FARTHEST = 20.0


def search_course_figure(
    seconds: Sequence[float],
    merits: Sequence[float],
    best: Sequence[float],
    forms: Sequence[int],
    merit_label: str = "merit",
    within: float = 0.25,
    title: str | None = None,
) -> Figure:
    """Plot every design that a search found, the best so far, and below it the number of forms.

    Args:
        seconds: (N,), s, wall time at which each design was found, ascending.
        merits: (N,), of the designs.
        best: (N,), the least merit so far.
        forms: (N,), number of different forms so far within a share of the best so far.
        merit_label: of the axis, with its unit.
        within: that share.
        title: above all.

    Raises:
        InputError: there are no designs, or the numbers of values differ.
    """
    counts = {len(seconds), len(merits), len(best), len(forms)}
    if len(counts) > 1 or not len(seconds):
        raise InputError(
            f"course of a search: {len(seconds)} times, {len(merits)} merits, {len(best)} best and "
            f"{len(forms)} forms; allowed: as many of each, and one at least"
        )
    figure = Figure(figsize=(5.6, 4.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
    upper.plot(
        seconds, merits, "o", color="0.6", markersize=2.6, markeredgewidth=0.0, label="designs"
    )
    # Designs that were known at once make one step.
    steps = dict(zip(seconds, zip(best, forms, strict=True), strict=True))
    times = [*steps, max(seconds)]
    least, number = (list(values) for values in zip(*steps.values(), strict=True))
    upper.step(
        *(times, [*least, best[-1]]),
        where="post",
        color=PALETTE[1],
        linewidth=1.4,
        label="best so far",
    )
    near = [merit for merit in merits if merit <= _FARTHEST * best[-1]]
    if best[-1] > 0.0 and max(near) > _WIDE * best[-1]:
        upper.set_yscale("log")
        upper.set_ylim(0.85 * best[-1], 1.2 * max(near))
        log_ticks(upper.yaxis)
    else:
        upper.set_ylim(best[-1] - 0.08 * (max(near) - best[-1] or best[-1]), None)
    upper.set_ylabel(merit_label, fontsize=SMALL + 1)
    lower.step(times, [*number, forms[-1]], where="post", color=PALETTE[0], linewidth=1.4)
    lower.yaxis.set_major_locator(MaxNLocator(integer=True))
    lower.set_ylim(0.0, 1.1 * max(*number, 1))
    lower.set_xlim(0.0, None)
    lower.set_ylabel(f"forms within {100.0 * within:g} %\nof the best (number)", fontsize=SMALL + 1)
    lower.set_xlabel("wall time (s)", fontsize=SMALL + 1)
    ruled_axes(upper)
    ruled_axes(lower)
    figure.align_ylabels()
    handles, names = upper.get_legend_handles_labels()
    legend_below(figure, handles, 2, names)
    draw_axes_title(upper, title)
    return figure


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
