"""Wavefront maps, their Zernike coefficients and Strehl ratios over the field are plotted."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dolens.analysis.conditions import FieldScan
from dolens.diffraction.point_spread import StrehlRatios
from dolens.diffraction.wavefront_map import WavefrontMaps
from dolens.optics.fields import field_label
from dolens.plotting.field_curves import note_if_empty, scan_label
from dolens.plotting.style import (
    PAGE,
    SMALL,
    draw_title,
    legend_below,
    number_text,
    ordered_colours,
    ruled_axes,
    spectral_colour,
    wavelength_handles,
)

# Blue behind the sphere and red ahead of it: told apart by colour-blind readers, white is zero.
_COLOURS = "RdBu_r"
_COLUMNS = 4
# Half width of a scale on which rounding is no aberration, waves.
_FLAT = 1e-6
# Terms of the bars: fringe up to secondary spherical.
_TERMS = 16


def wavefront_maps_figure(maps: WavefrontMaps, title: str | None = "Wavefront error") -> Figure:
    """Show the wavefront error of every field and wavelength over the stop, each on its own scale.

    Red is ahead of the reference sphere (early), blue behind it.  Above each panel stand the field,
    the wavelength where there are several, RMS and peak to valley.

    Args:
        maps: the data.
        title: above all panels.
    """
    shape = maps.rms.shape
    count, columns = shape.numel(), min(shape.numel(), _COLUMNS)
    rows = math.ceil(count / columns)
    width = PAGE if columns > 2 else max(1.0 + 2.6 * columns, 4.2)
    figure = Figure(figsize=(width, (width / columns + 1.0) * rows + 0.3), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for number, axes in enumerate(grid.flat):
        if number >= count:
            axes.set_visible(False)
            continue
        if not _draw(figure, axes, maps, *divmod(number, shape[1])):
            axes.set(xticks=[], yticks=[])
            continue
        axes.set_xlabel("x / semi-diameter", fontsize=SMALL)
        if number % columns == 0:
            axes.set_ylabel("y / semi-diameter of the stop", fontsize=SMALL)
    draw_title(figure, title)
    return figure


def _draw(figure: Figure, axes: Axes, maps: WavefrontMaps, row: int, column: int) -> bool:
    """Draw one map; return whether there is light."""
    label = field_label(maps.fields[row], maps.field_unit)
    if len(maps.wavelengths) > 1:
        label += f", {float(maps.wavelengths[column]):.4g} nm"
    axes.tick_params(labelsize=SMALL - 1)
    axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), box_aspect=1.0)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(2, steps=(1, 2, 5, 10)))
    rms = float(maps.rms[row, column])
    if math.isnan(rms):
        axes.set_title(f"{label}\nno light passes", fontsize=SMALL)
        return False
    error, inside = maps.error[row, column].numpy(), maps.inside[row, column].numpy()
    x, y = (maps.stop[row, column, ..., axis].numpy() for axis in (0, 1))
    most = max(float(np.abs(error[inside]).max()), _FLAT)
    mesh = axes.pcolormesh(
        np.nan_to_num(x),
        np.nan_to_num(y),
        np.ma.masked_array(error, ~inside),
        cmap=_COLOURS,
        vmin=-most,
        vmax=most,
        shading="nearest",
        rasterized=True,
        gid="wavefront",
    )
    bar = figure.colorbar(mesh, ax=axes, orientation="horizontal", aspect=16, pad=0.02)
    bar.locator = MaxNLocator(4, symmetric=True)
    bar.update_ticks()
    bar.ax.tick_params(labelsize=SMALL - 1)
    bar.set_label("wavefront error (waves)", fontsize=SMALL)
    valley = float(maps.peak_to_valley[row, column])
    axes.set_title(
        f"{label}\nRMS {number_text(rms, 3)}, P–V {number_text(valley, 3)} waves", fontsize=SMALL
    )
    return True


def zernike_figure(
    maps: WavefrontMaps,
    order: str = "fringe",
    terms: int = _TERMS,
    title: str | None = "Zernike coefficients",
) -> Figure:
    """Plot Zernike coefficients of every field at the first wavelength as bars, piston left out.

    Args:
        maps: the data; all terms that the order has as a default are fitted.
        order: `fringe` or `standard`.
        terms: how many of them to show.
        title: above the axes.
    """
    fit = maps.zernike(order)
    shown = range(1, min(terms, len(fit.terms)))
    figure = Figure(figsize=(PAGE, 0.9 + 0.24 * len(shown)), layout="constrained")
    axes = figure.subplots()
    lit = [n for n in range(len(maps.fields)) if math.isfinite(float(maps.rms[n, 0]))]
    height = 0.8 / max(len(lit), 1)
    colours = ordered_colours(len(maps.fields))
    bars: list[Any] = []
    for place, number in enumerate(lit):
        at = np.arange(len(shown)) + (place - 0.5 * (len(lit) - 1)) * height
        label = field_label(maps.fields[number], maps.field_unit)
        values = fit.coefficients[number, 0, 1 : 1 + len(shown)].numpy()
        bars.append(axes.barh(at, values, height, color=colours[number], label=label, zorder=3))
    names = [f"{fit.names[n]}  Z{n + 1}" for n in shown]
    axes.set_yticks(np.arange(len(shown)), names, fontsize=SMALL - 1)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.axvline(0.0, color="0.6", linewidth=0.8, zorder=4)
    axes.set_xlabel(f"{order} coefficient (waves)", fontsize=SMALL + 1)
    ruled_axes(axes)
    axes.tick_params(axis="y", labelsize=SMALL - 1)
    if bars:
        legend_below(figure, bars, 6)
    draw_title(figure, title)
    return figure


# A ratio that a lens is called limited by diffraction from (Maréchal's criterion).
_LIMIT = 0.8


def strehl_figure(
    scans: list[tuple[FieldScan, StrehlRatios]], title: str | None = "Strehl ratio"
) -> Figure:
    """Plot Strehl ratios over the field: of the peak solid, by Maréchal's formula dashed.

    A thin line marks 0.8, from which a lens is called limited by diffraction.

    Args:
        scans: of one scan, or of several, a panel each.
        title: above all.
    """
    figure = Figure(figsize=(PAGE if len(scans) > 1 else 5.4, 3.5), layout="constrained")
    grid = figure.subplots(1, len(scans), squeeze=False, sharey=True)[0]
    for axes, (scan, found) in zip(grid, scans, strict=True):
        field = scan.coordinate.numpy()
        axes.axhline(_LIMIT, color="0.6", linewidth=0.8, zorder=1)
        for number, wavelength in enumerate(found.wavelengths):
            style = {"color": spectral_colour(float(wavelength)), "linewidth": 1.4, "zorder": 3}
            axes.plot(field, found.peak[:, number], gid="peak", **style)
            axes.plot(field, found.marechal[:, number], gid="marechal", linestyle="--", **style)
        note_if_empty(axes, found.marechal.numpy(), "no light passes")
        axes.set_xlim(field.min(), field.max())
        axes.set_xlabel(scan_label(scan), fontsize=SMALL + 1)
        ruled_axes(axes)
    grid[0].set(ylim=(0.0, 1.02))
    grid[0].set_ylabel("Strehl ratio (of a perfect lens: 1)", fontsize=SMALL + 1)
    handles = [
        Line2D([], [], color="0.25", linewidth=1.4, label="peak of the PSF"),
        Line2D([], [], color="0.25", linewidth=1.4, linestyle="--", label="Maréchal, exp(−(2πσ)²)"),
        *wavelength_handles(scans[0][1].wavelengths),
    ]
    legend_below(figure, handles, 5)
    draw_title(figure, title)
    return figure
