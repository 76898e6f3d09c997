"""These figures show errors of a pose fit by photons and by rays, and its basin of convergence."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dolens.alignment.pose import Pose
from dolens.experiments.poses.basin import Basin
from dolens.experiments.poses.labels import variable_label
from dolens.experiments.tables import Row
from dolens.plotting.style import SMALL, TITLE, colours, ruled_axes
from dolens.rendering.spot_image import SpotImager

_LABELS = {"noise_weighted": "weighted by noise", "s21": "S21"}
_MARKERS = {"noise_weighted": "o", "s21": "s"}
_LINES = {"noise_weighted": "-", "s21": "--"}


def photons_figure(rows: Sequence[Row], true: Pose, title: str) -> Figure:
    """Draw a panel for each variable: RMS errors of both estimates, and the bound.

    Args:
        rows: of accuracy.csv.
        true: the pose whose variables are fitted.
        title: the title.
    """
    names = true.names
    figure = Figure(figsize=(2.6 * len(names), 3.3), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(names)))
    for axes, name, unit in zip(panels, names, true.unit_names, strict=True):
        own = [r for r in rows if r["part"] == "photons" and r["variable"] == name]
        for estimator, colour in zip(_LABELS, colours(2), strict=True):
            mine = [r for r in own if r["estimator"] == estimator]
            counts = [r["count"] for r in mine]
            axes.plot(
                counts,
                [r["rms_error"] for r in mine],
                _MARKERS[estimator],
                color=colour,
                label=f"RMS error, {_LABELS[estimator]}",
                markersize=5,
            )
        axes.plot(counts, [r["bound"] for r in mine], color="0.3", linewidth=1.0, label="bound")
        axes.set(xscale="log", yscale="log")
        axes.set_title(variable_label(name), fontsize=SMALL + 1)
        axes.set_xlabel("photons", fontsize=SMALL + 1)
        axes.set_ylabel(unit, fontsize=SMALL + 1)
        ruled_axes(axes)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=SMALL
    )
    figure.suptitle(title, fontsize=TITLE)
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
        name: the name of the lens, for the title.
    """
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
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
    axes.axhline(1.0, color="0.3", linewidth=1.0)
    axes.text(
        ray_counts[0],
        1.08,
        f"bound of {photons:.3g} photons",
        fontsize=SMALL,
        color="0.3",
        va="bottom",
    )
    floor = numbers["pose_error/reference_over_bound"]
    axes.axhspan(0.0, floor, color="0.92", label="noise of the reference", zorder=0)
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("rays of a source", fontsize=SMALL + 1)
    axes.set_ylabel("RMS error over bound", fontsize=SMALL + 1)
    ruled_axes(axes)
    axes.legend(frameon=False, fontsize=SMALL)
    figure.suptitle(f"{name}: error that the model's rays make", fontsize=TITLE)
    return figure


def basin_figure(basin: Basin, name: str) -> Figure:
    """Draw a map of final errors against errors of the start, for each centroid weight."""
    shares = basin.summary()
    weights = basin.centroid_weights
    figure = Figure(figsize=(1.2 + 4.2 * len(weights), 4.0), layout="constrained")
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
        axes.set_xticks(range(len(errors[0])), [f"{e:g}" for e in errors[0]], fontsize=SMALL)
        axes.set_yticks(range(len(errors[1])), [f"{e:g}" for e in errors[1]], fontsize=SMALL)
        axes.set_xlabel(_start(across, units), fontsize=SMALL + 1)
        share = shares[f"basin/converged/centroid_weight_{weight:g}"]
        axes.set_title(f"μ = {weight:g} /mm²: {100.0 * share:.0f} % converge", fontsize=SMALL + 1)
    panels[0].set_ylabel(_start(up, units), fontsize=SMALL + 1)
    bar = figure.colorbar(shown, ax=list(panels), pad=0.01, extend="both")
    bar.set_label("RMS error of the fit over bound", fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    figure.suptitle(f"{name}: from where a fit converges", fontsize=TITLE)
    return figure


def _start(name: str, units: dict[str, str]) -> str:
    return f"error of the start, {variable_label(name)}, {units[name]}"


def _write(axes: Axes, table: np.ndarray) -> None:
    """Write the number into each cell."""
    for row, column in np.ndindex(*table.shape):
        value = table[row, column]
        text = f"{value:.2g}" if value < 100.0 else f"{value:.0e}".replace("e+0", "e")
        pale = "white" if value > 100.0 else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=SMALL - 2, color=pale)
