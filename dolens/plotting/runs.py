"""Metrics of runs are plotted: by row, against a swept setting, or against seconds of training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from dolens.plotting.style import (
    PAGE,
    PALETTE,
    SMALL,
    TITLE,
    colours,
    draw_axes_title,
    draw_title,
    legend_below,
    ruled_axes,
)

# Characters of a row's label, and so many in a line of it.
_LONGEST, _LINE = 110, 44
# Settings that span this ratio are drawn on a logarithmic axis.
_DECADES = 30.0


class RunPoint(NamedTuple):
    """A `RunPoint` is a metric of the runs that differ only in the seed.

    Attributes:
        mean: over the seeds.
        seeds: the value of each.
        low: lower end of an interval; None: the seeds' own range is drawn.
        high: upper end likewise.
    """

    mean: float
    seeds: Sequence[float]
    low: float | None = None
    high: float | None = None

    def ends(self) -> tuple[float, float]:
        """Return the ends of the error bar."""
        if self.low is None or self.high is None:
            return min(self.seeds), max(self.seeds)
        return self.low, self.high


def runs_figure(
    labels: Sequence[str], points: Sequence[RunPoint], metric: str, title: str | None = None
) -> Figure:
    """Plot a metric of each row: its mean with an error bar, and the seeds as dots.

    Args:
        labels: of the rows, from above.
        points: likewise.
        metric: label of the axis, with its unit.
        title: above the axes.

    Returns:
        A figure with the rows from above to below.
    """
    texts = [_wrapped(label) for label in labels]
    lines = sum(text.count("\n") + 1 for text in texts)
    figure = Figure(figsize=(7.5, 1.3 + 0.16 * lines + 0.14 * len(texts)), layout="constrained")
    axes = figure.add_subplot()
    heights = range(len(points))
    for height, point in zip(heights, points, strict=True):
        low, high = point.ends()
        bar = [[max(point.mean - low, 0.0)], [max(high - point.mean, 0.0)]]
        axes.errorbar(
            point.mean, height, xerr=bar, fmt="o", color=PALETTE[0], capsize=3, markersize=5
        )
        if len(point.seeds) > 1:
            _dots(axes, point.seeds, [height] * len(point.seeds), PALETTE[1])
    axes.set_yticks(list(heights), texts)
    axes.set_ylim(len(points) - 0.5, -0.5)
    axes.margins(x=0.08)
    axes.set_xlabel(metric, fontsize=SMALL + 1)
    _finish(figure, axes, points, title)
    return figure


def runs_curve(
    lines: Mapping[str, Sequence[tuple[float, RunPoint]]],
    setting: str,
    metric: str,
    title: str | None = None,
) -> Figure:
    """Plot a metric against a setting: a line for each of some names, with error bars and seeds.

    Args:
        lines: name (empty for a single line) → values of the setting with their points.
        setting: label of the x axis, with its unit.
        metric: label of the y axis, with its unit.
        title: above the axes.

    Returns:
        A figure; the x axis is logarithmic where the settings are positive and span a factor of
        more than 30.
    """
    figure = Figure(figsize=(6.8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for (name, line), colour in zip(lines.items(), colours(len(lines)), strict=True):
        ordered = sorted(line, key=lambda pair: pair[0])
        x, points = [value for value, _ in ordered], [point for _, point in ordered]
        means = [point.mean for point in points]
        below = [max(point.mean - point.ends()[0], 0.0) for point in points]
        above = [max(point.ends()[1] - point.mean, 0.0) for point in points]
        axes.errorbar(
            x,
            means,
            (below, above),
            fmt="o-",
            color=colour,
            capsize=3,
            markersize=5,
            linewidth=1.2,
            label=_wrapped(name),
        )
        for value, point in ordered:
            if len(point.seeds) > 1:
                _dots(axes, [value] * len(point.seeds), point.seeds, colour)
    settings = [value for line in lines.values() for value, _ in line]
    if min(settings) > 0.0 and max(settings) > _DECADES * min(settings):
        axes.set_xscale("log")
    else:
        axes.set_xticks(sorted(set(settings)) if len(set(settings)) <= 8 else axes.get_xticks())
        axes.margins(x=0.06)
    axes.set_xlabel(setting, fontsize=SMALL + 1)
    axes.set_ylabel(metric, fontsize=SMALL + 1)
    if len(lines) > 1:
        figure.legend(loc="outside lower center", frameon=False, fontsize=SMALL, ncols=2)
    _finish(figure, axes, [point for line in lines.values() for _, point in line], title)
    return figure


def _dots(axes: Axes, x: Sequence[float], y: Sequence[float], colour: str) -> None:
    axes.plot(x, y, "o", markersize=3.5, markerfacecolor="white", markeredgecolor=colour, zorder=3)


def _finish(figure: Figure, axes: Axes, points: Sequence[RunPoint], title: str | None) -> None:
    for axis in (axes.xaxis, axes.yaxis):
        formatter = axis.get_major_formatter()
        if isinstance(formatter, ScalarFormatter):
            formatter.set_useOffset(False)
    ruled_axes(axes)
    notes = []
    if any(len(point.seeds) > 1 for point in points):
        notes.append("bars: range over seeds, open dots: seeds")
    if any(point.low is not None for point in points):
        notes.append("bars of single runs: 95 % interval over photographs")
    heading = "\n".join(text for text in (title, "; ".join(notes)) if text)
    draw_axes_title(axes, heading, TITLE if not notes else SMALL + 1)


def _wrapped(label: str) -> str:
    """Return a label in lines, broken behind commas; its end is left out where it is too long."""
    text = label if len(label) <= _LONGEST else f"{label[: _LONGEST - 1]}…"
    lines = [""]
    for part in text.split(", "):
        joined = f"{lines[-1]}, {part}" if lines[-1] else part
        if len(joined) > _LINE and lines[-1]:
            lines[-1] += ","
            lines.append(part)
        else:
            lines[-1] = joined
    return "\n".join(lines)


@dataclass(frozen=True)
class Curve:
    """A `Curve` holds the quality of one network.

    Attributes:
        label: of the network.
        seconds: of training, ascending.
        quality: PSNR in dB at each of them.
        low: lower ends of its intervals, dB.
        high: upper ends.
    """

    label: str
    seconds: Sequence[float]
    quality: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]


def quality_figure(
    found: Sequence[Curve], title: str | None = "Quality against seconds of training"
) -> Figure:
    """Plot PSNR at the worst depth against process time of training, with bars for intervals.

    Args:
        found: one or more.
        title: above all.
    """
    figure = Figure(figsize=(PAGE * 0.8, 3.8), layout="constrained")
    axes = figure.subplots()
    handles: list[Artist] = []
    for curve, colour, marker in zip(found, colours(len(found)), _MARKERS, strict=False):
        below = [q - low for q, low in zip(curve.quality, curve.low, strict=True)]
        above = [high - q for q, high in zip(curve.quality, curve.high, strict=True)]
        # Side by side, as all have trained for the same seconds.
        seconds = [s * (1.0 + 0.015 * len(handles)) for s in curve.seconds]
        bars = axes.errorbar(
            seconds,
            curve.quality,
            (below, above),
            color=colour,
            marker=marker,
            elinewidth=0.6,
        )
        handles.append(bars.lines[0])
    axes.set_xlim(left=0.0)
    axes.set_xlabel("seconds of training, one processor", fontsize=SMALL)
    axes.set_ylabel("PSNR at the worst depth (dB)", fontsize=SMALL)
    ruled_axes(axes)
    legend_below(figure, handles, 3, [curve.label for curve in found])
    draw_title(figure, title)
    return figure


_MARKERS = "osD^v<>Px*" * 2
