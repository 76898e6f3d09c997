"""The gain of a coded aperture over a plain lens is plotted against light, for each depth range."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from dolens.plotting.legends import legend_below
from dolens.plotting.style import PAGE, SMALL, colours, ruled_axes
from dolens.plotting.ticks import log_ticks
from dolens.plotting.titles import draw_title


@dataclass(frozen=True)
class GainRange:
    """A `GainRange` holds the gains (dB) of one depth range.

    Attributes:
        label: of the range, as `4.5 to 8 m`.
        lights: of the bound, electrons of a white pixel at full aperture.
        common_filter: the bound's gain with one linear filter for all depths.
        filter_per_depth: the bound's gain with a linear filter for each depth.
        trained: light, gain, and the lower and upper end of its interval, of trained cameras.
    """

    label: str
    lights: Sequence[float] = ()
    common_filter: Sequence[float] = ()
    filter_per_depth: Sequence[float] = ()
    trained: Sequence[tuple[float, float, float, float]] = ()


def coding_gain_figure(
    ranges: Sequence[GainRange], title: str | None = "Gain over the best plain lens"
) -> Figure:
    """Plot gain against light, with axes for each depth range.

    Lines are bounds of linear restoration; points with bars are trained cameras with their
    intervals.

    Args:
        ranges: one or more.
        title: above all.
    """
    figure = Figure(figsize=(max(PAGE * len(ranges) / 2.0, 4.6), 3.4), layout="constrained")
    grid = figure.subplots(1, len(ranges), squeeze=False, sharey=True, sharex=True)
    blue, orange, green = colours(3)
    for axes, found in zip(grid[0], ranges, strict=True):
        axes.axhline(0.0, color="0.3", linewidth=0.8)
        if len(found.lights):
            axes.plot(
                found.lights, found.common_filter, color=blue, label="bound, one linear filter"
            )
            axes.plot(
                found.lights,
                found.filter_per_depth,
                color=green,
                ls="--",
                label="bound, a filter for each depth",
            )
        if found.trained:
            light, gain, low, high = zip(*found.trained, strict=True)
            below = [g - bottom for g, bottom in zip(gain, low, strict=True)]
            above = [top - g for g, top in zip(gain, high, strict=True)]
            axes.errorbar(
                light,
                gain,
                (below, above),
                fmt="o",
                color=orange,
                capsize=3,
                label="trained cameras",
            )
        axes.set_xscale("log")
        axes.set_title(found.label, fontsize=SMALL + 1)
        axes.set_xlabel("light (electrons of a white pixel, full aperture)", fontsize=SMALL)
        ruled_axes(axes)
    for axes, letter in zip(grid[0], "abcdefgh", strict=False):
        log_ticks(axes.xaxis)
        axes.set_title(f"({letter})", loc="left", fontsize=SMALL + 1, fontweight="bold")
    grid[0, 0].set_ylabel("gain at the worst depth (dB)", fontsize=SMALL)
    handles: dict[str, Any] = {}
    for axes in grid[0]:
        handles |= {label: h for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if handles:
        legend_below(figure, list(handles.values()), len(handles), list(handles))
    draw_title(figure, title)
    return figure
