"""These figures show errors of a pose fit by photons and by rays, and its basin of convergence."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.pose import Pose
from dolens.experiments.poses.accuracy_tasks import Basin
from dolens.experiments.tables import Row
from dolens.plotting.style import (
    PAGE,
    SMALL,
    colours,
    draw_title,
    legend_below,
    log_ticks,
    number_text,
    ruled_axes,
)
from dolens.plotting.tolerances import parameter_label
from dolens.rendering.spot_image import SpotImager

_LABELS = {"noise_weighted": "weighted by noise", "s21": "S21"}
_MARKERS = {"noise_weighted": "o", "s21": "s"}
# Panels side by side.
_PANELS = 3
_LINES = {"noise_weighted": "-", "s21": "--"}


def photons_figure(
    rows: Sequence[Row], true: Pose, title: str, measurements: int | None = None
) -> Figure:
    """Draw a panel for each variable: RMS errors of both estimates, and the bound.

    Bars are standard errors: an RMS value of n normal errors has one of itself over √(2n).

    Args:
        rows: of accuracy.csv.
        true: the pose whose variables are fitted.
        title: the title.
        measurements: n, of each RMS error; None for no bars.
    """
    names = true.names
    rows_of_panels = -(-len(names) // _PANELS)
    columns = -(-len(names) // rows_of_panels)
    size = (max(PAGE * columns / _PANELS, 4.0), 2.4 * rows_of_panels + 0.9)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows_of_panels, columns, squeeze=False).flatten()
    for axes in grid[len(names) :]:
        axes.set_visible(False)
    panels = grid[: len(names)]
    for axes, name, unit in zip(panels, names, true.unit_names, strict=True):
        own = [r for r in rows if r["part"] == "photons" and r["variable"] == name]
        for estimator, colour in zip(_LABELS, colours(2), strict=True):
            mine = [r for r in own if r["estimator"] == estimator]
            counts = [r["count"] for r in mine]
            found = [float(r["rms_error"]) for r in mine]
            share = (2.0 * measurements) ** -0.5 if measurements else 0.0
            spread = [share * value for value in found] if measurements else None
            axes.errorbar(
                counts,
                found,
                spread,
                fmt=_MARKERS[estimator],
                color=colour,
                label=f"RMS error, {_LABELS[estimator]}",
                markersize=5,
                capsize=2,
                linewidth=1.0,
            )
        axes.plot(counts, [r["bound"] for r in mine], color="0.3", linewidth=1.0, label="bound")
        axes.set(xscale="log", yscale="log")
        axes.set_title(parameter_label(name), fontsize=SMALL + 1)
        axes.set_xlabel("photons of a source", fontsize=SMALL + 1)
        printed = "°" if unit == "deg" else unit
        axes.set_ylabel(f"error ({printed})", fontsize=SMALL + 1)
        ruled_axes(axes)
        log_ticks(axes.xaxis, 3)
        log_ticks(axes.yaxis, 5)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, 3, labels)
    draw_title(figure, title)
    return figure


def rays_figure(
    numbers: Mapping[str, float],
    imagers: Mapping[str, SpotImager],
    ray_counts: Sequence[int],
    photons: int,
    name: str,
) -> Figure:
    """Draw the errors that few rays make, over the bound of the quoted light.

    Args:
        numbers: metrics of the run.
        imagers: name → how images are made.
        ray_counts: of a source.
        photons: of a source, that the bound is of.
        name: the lens and its aperture, for the title.
    """
    figure = Figure(figsize=(PAGE, 4.6), layout="constrained")
    axes = figure.subplots(1, 1)
    for (imager, settings), colour in zip(imagers.items(), colours(len(imagers)), strict=True):
        for estimator in _LABELS:
            found = [
                numbers[f"pose_error/over_bound/rays/{imager}_{count:g}/{estimator}"]
                for count in ray_counts
            ]
            axes.plot(
                ray_counts,
                found,
                marker=_MARKERS[estimator],
                linestyle=_LINES[estimator],
                color=colour,
                markersize=5,
                linewidth=1.2,
                label=f"{_LABELS[estimator]}, rim {settings.rim:g}, {settings.subpixels} subpixels",
            )
    axes.axhline(1.0, color="0.3", linewidth=1.0, label=f"bound of {number_text(photons)} photons")
    floor = numbers["pose_error/reference_over_bound"]
    axes.axhspan(0.0, floor, color="0.92", label="noise of the reference", zorder=0)
    axes.set(xscale="log", yscale="log")
    lowest = min([floor, *(min(line.get_ydata()) for line in axes.get_lines())])
    axes.set_ylim(bottom=0.6 * lowest)
    axes.set_xlabel("rays of a source", fontsize=SMALL + 1)
    axes.set_ylabel("RMS error over bound (no unit)", fontsize=SMALL + 1)
    ruled_axes(axes)
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, 2, labels)
    draw_title(figure, f"{name}\nerror that the model's rays make")
    return figure


def basin_figure(basin: Basin, name: str) -> Figure:
    """Draw a map of final errors against errors of the start, for each centroid weight."""
    shares = basin.summary()
    weights = basin.centroid_weights
    figure = Figure(figsize=(PAGE, 3.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(weights), sharey=True))
    units = dict(zip(basin.true.names, basin.true.unit_names, strict=True))
    across, up = basin.along
    for axes, weight in zip(panels, weights, strict=True):
        table = basin.table(weight).numpy()
        shown = axes.imshow(
            np.clip(table, 1.0, None),
            norm=LogNorm(1.0, 1e4),
            cmap="viridis_r",
            origin="lower",
            aspect="auto",
        )
        _write(axes, table)
        errors = list(basin.along.values())
        axes.set_xticks(range(len(errors[0])), [number_text(e) for e in errors[0]], fontsize=SMALL)
        axes.set_yticks(range(len(errors[1])), [number_text(e) for e in errors[1]], fontsize=SMALL)
        axes.set_xlabel(_start(across, units), fontsize=SMALL + 1)
        share = shares[f"basin/converged/centroid_weight_{weight:g}"]
        axes.set_title(f"μ = {weight:g} /mm²: {100.0 * share:.0f} % converge", fontsize=SMALL + 1)
    panels[0].set_ylabel(_start(up, units), fontsize=SMALL + 1)
    bar = figure.colorbar(shown, ax=list(panels), pad=0.01, extend="both")
    bar.set_label("RMS error of the fit over bound (no unit)", fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    draw_title(figure, f"{name}\nfrom where a fit converges")
    return figure


def draw_shares(
    axes: Axes, labels: Sequence[str], errors: Sequence[Tensor], size: float = SMALL
) -> None:
    """Shade one bound and two, name the rows, and write how many errors of each lie within both.

    Args:
        axes: of errors over their bounds.
        labels: of the rows, from above.
        errors: over bounds, of each row.
        size: of the text, points of 1/72 inch.
    """
    for times, shade in ((2.0, "0.93"), (1.0, "0.86")):
        axes.axvspan(-times, times, color=shade, zorder=0)
    for row, off in enumerate(errors):
        shares = [100.0 * float((off.abs() < times).double().mean()) for times in (1.0, 2.0)]
        axes.annotate(
            f"{shares[0]:.0f} % | {shares[1]:.0f} %",
            (1.01, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=size,
        )
    axes.annotate(
        "within\n±1 | ±2", (1.01, 1.0), xycoords="axes fraction", va="bottom", fontsize=SMALL
    )
    axes.set_yticks(range(len(labels)), labels, fontsize=size)
    axes.set_ylim(len(labels) - 0.5, -0.5)


def _start(name: str, units: dict[str, str]) -> str:
    unit = "°" if units[name] == "deg" else units[name]
    return f"error of the start, {parameter_label(name)} ({unit})"


def _write(axes: Axes, table: np.ndarray) -> None:
    """Write the number into each cell."""
    for row, column in np.ndindex(*table.shape):
        value = table[row, column]
        text = number_text(value, 2 if value < 100.0 else 1)
        pale = "white" if value > 100.0 else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=SMALL - 2, color=pale)
