"""Gains of cameras for an extended depth of field are plotted against light, by depth range."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from dolens.plotting.legends import legend_below
from dolens.plotting.style import PAGE, SMALL, colours, ruled_axes
from dolens.plotting.ticks import log_ticks
from dolens.plotting.titles import draw_title


@dataclass(frozen=True)
class GainRange:
    """A `GainRange` holds the gains (dB) of cameras at one depth range.

    Attributes:
        label: of the range, as `4.5 to 8 m`.
        lights: of the bounds, electrons of a white pixel at full aperture.
        bounds: camera → for each light the bound's gain with one linear filter for all depths, and
            with one for each.
        judged: camera and restorer, as `sweep, blind` → light → gain, and the lower and upper end
            of its interval.
    """

    label: str
    lights: Sequence[float] = ()
    bounds: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    judged: Mapping[str, Mapping[float, tuple[float, float, float]]] = field(default_factory=dict)


def coding_gain_figure(
    ranges: Sequence[GainRange], title: str | None = "Gain over the best plain lens"
) -> Figure:
    """Plot gain against light, with axes for each depth range.

    Lines are bounds of linear restoration, whole with one filter for all depths and dashed with one
    for each; points with bars are photographs with their intervals, full where the restorer is
    blind to depth and empty where it chooses the depth.

    Args:
        ranges: one or more.
        title: above all.
    """
    figure = Figure(figsize=(max(PAGE * len(ranges) / 2.0, 4.6), 3.9), layout="constrained")
    grid = figure.subplots(1, len(ranges), squeeze=False, sharey=True, sharex=True)
    names = list(dict.fromkeys(name for found in ranges for name in found.bounds))
    names += [
        n for n in dict.fromkeys(_camera(j) for r in ranges for j in r.judged) if n not in names
    ]
    colour = dict(zip(names, colours(len(names)), strict=True))
    for axes, found in zip(grid[0], ranges, strict=True):
        axes.axhline(0.0, color="0.3", linewidth=0.8)
        for name, gains in found.bounds.items():
            common, each = zip(*gains, strict=True)
            axes.plot(found.lights, common, color=colour[name], label=f"{name}, one linear filter")
            axes.plot(
                found.lights,
                each,
                color=colour[name],
                ls="--",
                label=f"{name}, a filter for each depth",
            )
        for name, points in found.judged.items():
            light, gain, low, high = zip(*((k, *v) for k, v in points.items()), strict=True)
            below = [g - bottom for g, bottom in zip(gain, low, strict=True)]
            above = [top - g for g, top in zip(gain, high, strict=True)]
            own = colour[_camera(name)]
            axes.errorbar(
                light,
                gain,
                (below, above),
                fmt="o",
                color=own,
                markerfacecolor="white" if name.endswith("by depth") else own,
                markersize=4,
                capsize=2,
                label=name,
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
        legend_below(figure, list(handles.values()), 3, list(handles))
    draw_title(figure, title)
    return figure


def _camera(name: str) -> str:
    """Return the camera of `sweep, blind`."""
    return name.rpartition(", ")[0]
