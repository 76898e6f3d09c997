"""The quality of cameras is plotted against the spots of their lenses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from dolens.errors import InputError
from dolens.plotting.label_placement import place_labels
from dolens.plotting.legends import legend_below
from dolens.plotting.style import SMALL, ordered_colours, ruled_axes
from dolens.plotting.titles import draw_axes_title


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
