"""Error is plotted against cost, with the Pareto front."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure

from dolens.plotting.style import SMALL, TITLE, colours, open_axes

_MARKERS = "osD^vP*X"


class Point(NamedTuple):
    """A `Point` is one alternative with its cost and error.

    Attributes:
        label: written beside it where it is on the front or marked.
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
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    least = floor or 0.0
    everything = [p for points in families.values() for p in points]
    front = pareto_front(everything)
    for (name, points), colour, marker in zip(
        families.items(), colours(len(families)), _MARKERS * len(families), strict=False
    ):
        x, y = [p.cost for p in points], [max(p.error, least) for p in points]
        sizes = [90.0 if p.marked else 22.0 for p in points]
        axes.scatter(x, y, sizes, color=colour, marker=marker, label=name, zorder=3)
        for point in points:
            if point.marked or point in front:
                axes.annotate(
                    point.label,
                    (point.cost, max(point.error, least)),
                    xytext=(5, 4),
                    textcoords="offset points",
                    fontsize=SMALL - 1,
                    color=colour,
                )
    if front:
        x = [p.cost for p in front]
        y = [max(p.error, least) for p in front]
        axes.step(x, y, where="post", color="0.6", linewidth=1.0, zorder=1, label="Pareto front")
    if floor:
        axes.axhline(floor, color="0.75", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel(cost, fontsize=SMALL + 1)
    axes.set_ylabel(error, fontsize=SMALL + 1)
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    open_axes(axes)
    axes.legend(frameon=False, fontsize=SMALL)
    if title:
        axes.set_title(title, fontsize=TITLE)
    return figure


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Return the points that no other point beats in cost and error, by rising cost."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cost, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front
