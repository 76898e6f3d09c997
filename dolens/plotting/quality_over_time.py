"""Image quality is plotted against seconds of training, for each network."""

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.artist import Artist
from matplotlib.figure import Figure

from dolens.plotting.legends import legend_below
from dolens.plotting.style import PAGE, SMALL, colours, ruled_axes
from dolens.plotting.titles import draw_title


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
