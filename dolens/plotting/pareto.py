"""Error is plotted against cost, with the Pareto front."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from dolens.plotting.label_placement import place_labels
from dolens.plotting.legends import legend_below
from dolens.plotting.style import MARKERS, PAGE, SMALL, colours, ruled_axes
from dolens.plotting.ticks import log_ticks
from dolens.plotting.titles import draw_axes_title

# Room around the points, as a share of the axes' length in decades, and at least in decades.
_ROOM, _LEAST_ROOM = 0.12, 0.15
# So many points all get their labels.
_FEW = 8


class Point(NamedTuple):
    """A `Point` is one alternative with its cost and error.

    Attributes:
        label: written beside it where it is on the front or marked, or where points are few.
        cost: positive.
        error: positive.
        marked: whether it is drawn large.
    """

    label: str
    cost: float
    error: float
    marked: bool = False


def pareto_figure(
    families: Mapping[str, Sequence[Point]],
    cost: str,
    error: str,
    title: str | None = None,
    floor: float | None = None,
) -> Figure:
    """Plot points on logarithmic axes, and the Pareto front as a staircase.

    Args:
        families: name → points; a colour and marker each.
        cost: label of the x axis, with its unit.
        error: label of the y axis, with its unit.
        title: above the axes.
        floor: error below which the reference cannot tell; drawn, and points below it put there.

    Returns:
        A figure.
    """
    figure = Figure(figsize=(PAGE, 4.4), layout="constrained")
    axes = figure.add_subplot()
    least = floor or 0.0
    everything = [p for points in families.values() for p in points]
    front = pareto_front(everything)
    labels = []
    for (name, points), colour, marker in zip(
        families.items(), colours(len(families)), MARKERS * len(families), strict=False
    ):
        x, y = [p.cost for p in points], [max(p.error, least) for p in points]
        sizes = [90.0 if p.marked else 22.0 for p in points]
        axes.scatter(x, y, sizes, color=colour, marker=marker, label=name, zorder=3)
        labels += [
            (p.label, p.cost, max(p.error, least), "black")
            for p in points
            if p.marked or p in front or len(everything) <= _FEW
        ]
    if front:
        x = [p.cost for p in front]
        y = [max(p.error, least) for p in front]
        axes.step(x, y, where="post", color="0.6", linewidth=1.0, zorder=1, label="Pareto front")
    if floor:
        look: dict[str, Any] = {"color": "0.5", "linewidth": 0.8, "linestyle": ":"}
        axes.axhline(floor, label="what the reference can tell", **look)
    axes.set(xscale="log", yscale="log")
    if everything:
        axes.set_xlim(*_limits([p.cost for p in everything]))
        axes.set_ylim(
            *_limits([max(p.error, least) for p in everything] + ([floor] if floor else []))
        )
    axes.set_xlabel(cost, fontsize=SMALL + 1)
    axes.set_ylabel(error, fontsize=SMALL + 1)
    ruled_axes(axes)
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    handles, names = axes.get_legend_handles_labels()
    legend_below(figure, handles, 4, names)
    draw_axes_title(axes, title)
    # One text for points at one place.
    place_labels(axes, list(dict.fromkeys(labels)), SMALL - 1)
    return figure


def _limits(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    factor = max((high / low) ** _ROOM, 10.0**_LEAST_ROOM)
    return low / factor, high * factor


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other point beats in cost and error, by rising cost."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cost, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front
