"""Spot diagrams are plotted."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from dolens.analysis.spot_diagram import SpotDiagram
from dolens.plotting.style import (
    SMALL,
    TITLE,
    field_label,
    ruled_axes,
    spectral_colour,
    wavelength_handles,
)

_PANEL = 1.75
# Fields of an overlaid diagram stand side by side, up to so many in a row.
_COLUMNS = 4


def spots_figure(
    spots: SpotDiagram, overlaid: bool = False, title: str | None = "Spot diagram"
) -> Figure:
    """Plot ray intercepts, in µm from the centroid of all light of the field.

    A row for every field and a column for every wavelength, all of one scale, so that colours that
    land apart are seen apart; or a panel for every field with all wavelengths in it.  The circle is
    Airy's, about the spot's centroid (overlaid: that of the reference or nearest wavelength); the
    cross is the chief ray of the reference wavelength, where it is within the panel.

    Artists carry gids: `spot`, `airy`, `chief`.

    Args:
        spots: the data.
        overlaid: one panel a field.
        title: above all panels.

    Returns:
        A figure; panels that no light reaches say so.
    """
    fields, waves = len(spots.fields), len(spots.wavelengths)
    centre = spots.polychromatic_centroid
    points = (1e3 * (spots.intercepts - centre[:, None, None])).numpy()
    middles = (1e3 * (spots.centroid - centre[:, None])).numpy()
    airy = 1e3 * spots.airy_radius.numpy()
    chief = (1e3 * (spots.chief - centre)).numpy()
    half = _half_width(points, airy)

    columns = min(fields, _COLUMNS) if overlaid else waves
    rows = math.ceil(fields / columns) if overlaid else fields
    figure = Figure(
        figsize=(
            max(_PANEL * columns + (0.55 if overlaid else 0.75), 4.2),
            (_PANEL + (0.5 if overlaid else 0.08)) * rows + (0.6 if overlaid else 1.25),
        ),
        layout="constrained",
    )
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    nearest = int((spots.wavelengths - spots.reference_wavelength).abs().argmin())
    for field in range(fields):
        label = field_label(spots.fields[field], spots.field_unit)
        if overlaid:
            axes = grid[divmod(field, columns)]
            # The widest first, so that none hides another.
            for wave in spots.rms[field].nan_to_num(0.0).argsort(descending=True).tolist():
                _scatter(axes, points[field, wave], float(spots.wavelengths[wave]))
            _marks(axes, chief[field], np.zeros(2), airy[nearest])
            radius = float(spots.polychromatic_rms[field])
            extent = np.linalg.norm(points[field], axis=-1)
            _radii(axes, radius, 1e-3 * float(np.nanmax(extent, initial=-math.inf)))
            axes.set_title(label, fontsize=SMALL + 1)
            continue
        for wave in range(waves):
            axes = grid[field, wave]
            wavelength = float(spots.wavelengths[wave])
            _scatter(axes, points[field, wave], wavelength)
            _marks(axes, chief[field], middles[field, wave], airy[wave])
            _radii(axes, float(spots.rms[field, wave]), float(spots.geo[field, wave]))
            if field == 0:
                axes.set_title(f"{wavelength:g} nm", fontsize=SMALL + 1)
        grid[field, 0].set_ylabel(f"{label}\ny (µm)", fontsize=SMALL + 1)
    _label(grid, fields, half, overlaid)
    _legend(figure, spots, overlaid)
    if title:
        figure.suptitle(title, fontsize=TITLE)
    return figure


def _half_width(points: np.ndarray, airy: np.ndarray) -> float:
    """Return the distance (µm) from the centre to the edge of every panel, with room for the
    numbers.
    """
    reach = max(float(np.nanmax(np.abs(points), initial=0.0)), float(airy.max()))
    return 1.2 * reach


def _scatter(axes: Axes, points: np.ndarray, wavelength: float) -> None:
    axes.plot(
        points[:, 0],
        points[:, 1],
        linestyle="none",
        marker="o",
        markersize=1.1,
        markeredgewidth=0.0,
        color=spectral_colour(wavelength),
        gid="spot",
        zorder=3,
    )


def _marks(axes: Axes, chief: np.ndarray, middle: np.ndarray, radius: float) -> None:
    if np.isfinite(middle).all():
        circle = Circle(
            tuple(middle), radius, fill=False, edgecolor="black", linewidth=0.8, gid="airy"
        )
        axes.add_patch(circle)
        circle.set_zorder(4)
    if np.isfinite(chief).all():
        style = {"markersize": 6, "markeredgewidth": 0.8, "color": "black"}
        axes.plot(*chief, marker="+", linestyle="none", gid="chief", zorder=5, **style)


def _radii(axes: Axes, rms: float, geo: float) -> None:
    """Write both radii, given in mm, in a panel's upper corner."""
    text = "no light passes" if math.isnan(rms) else f"RMS {1e3 * rms:.3g}, GEO {1e3 * geo:.3g} µm"
    axes.text(0.03, 0.985, text, va="top", fontsize=SMALL - 1, transform=axes.transAxes)


def _label(grid: np.ndarray, fields: int, half: float, overlaid: bool) -> None:
    for number, axes in enumerate(grid.flat):
        if overlaid and number >= fields:
            axes.set_visible(False)
            grid.flat[number - grid.shape[1]].tick_params(labelbottom=True)
        axes.set(xlim=(-half, half), ylim=(-half, half), box_aspect=1.0)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))
        ruled_axes(axes)
    for axes in grid[-1]:
        axes.set_xlabel("x (µm)", fontsize=SMALL + 1)
    if overlaid:
        for axes in grid[:, 0]:
            axes.set_ylabel("y (µm)", fontsize=SMALL + 1)


def _legend(figure: Figure, spots: SpotDiagram, overlaid: bool) -> None:
    style = {"linestyle": "none", "markersize": 6, "markeredgewidth": 0.8, "color": "black"}
    handles = wavelength_handles(spots.wavelengths) if overlaid else []
    handles += [
        Line2D([], [], marker="o", markerfacecolor="none", label="Airy disc", **style),
        Line2D([], [], marker="+", label="chief ray", **style),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=SMALL
    )
