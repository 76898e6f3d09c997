"""Error is plotted against cost, with the Pareto front, and image quality of cameras against the
spots of their lenses or against light; labels are placed beside points.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from dolens.errors import InputError
from dolens.plotting.style import (
    MARKERS,
    PAGE,
    SMALL,
    colours,
    draw_axes_title,
    draw_title,
    legend_below,
    log_ticks,
    ordered_colours,
    ruled_axes,
)

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


@dataclass(frozen=True)
class CamerasOfRung:
    """Holds the cameras that were trained alike.

    Attributes:
        label: of the legend, as `40 steps`.
        names: of the lenses, short.
        spots: µm, RMS radii of the lenses that the cameras began with.
        scores: of the cameras.
        deviations: over seeds; NaN draws no bar.
    """

    label: str
    names: Sequence[str]
    spots: Sequence[float]
    scores: Sequence[float]
    deviations: Sequence[float]


def spots_and_cameras_figure(
    rungs: Sequence[CamerasOfRung], score_label: str, title: str | None = None
) -> Figure:
    """Plot the score of each camera against the spot of its lens, a colour for each rung.

    A line joins the rungs of one lens, so that those that went on are seen.

    Args:
        rungs: the shortest training first.
        score_label: of the axis, with its unit.
        title: above all.

    Raises:
        InputError: there are no cameras.
    """
    if not rungs or not rungs[0].names:
        raise InputError("spots and cameras: there are no cameras")
    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    axes = figure.subplots()
    for name in rungs[0].names:
        at = [
            (r.spots[r.names.index(name)], r.scores[r.names.index(name)])
            for r in rungs
            if name in r.names
        ]
        axes.plot(*zip(*at, strict=True), color="0.75", linewidth=0.8, zorder=1)
    for rung, colour in zip(rungs, ordered_colours(len(rungs)), strict=True):
        bars = [0.0 if math.isnan(d) else d for d in rung.deviations]
        axes.errorbar(
            rung.spots,
            rung.scores,
            bars if any(bars) else None,
            fmt="o",
            color=colour,
            markersize=4.5,
            elinewidth=0.9,
            capsize=2.0,
            label=rung.label,
        )
    axes.margins(0.08)
    axes.set_xlabel("mean RMS spot radius of the search (µm)", fontsize=SMALL + 1)
    axes.set_ylabel(score_label, fontsize=SMALL + 1)
    ruled_axes(axes)
    draw_axes_title(axes, title)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, 4, labels)
    farthest = {
        name: (name, spot, score, "0.2")
        for rung in rungs
        for name, spot, score in zip(rung.names, rung.spots, rung.scores, strict=True)
    }
    place_labels(axes, list(farthest.values()), SMALL)
    return figure


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
