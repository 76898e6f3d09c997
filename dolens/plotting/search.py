"""The course of a search is plotted: what each trial reached, and what quality costs."""

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from dolens.plotting.label_placement import place_labels
from dolens.plotting.legends import legend_below
from dolens.plotting.style import PALETTE, SMALL, ruled_axes
from dolens.plotting.ticks import log_ticks
from dolens.plotting.titles import draw_axes_title

# Positive values that span this ratio are drawn on a logarithmic axis.
_DECADES = 30.0
# So many points of a front get their labels.
_FEW = 12


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
    if len(best) <= _FEW:
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
