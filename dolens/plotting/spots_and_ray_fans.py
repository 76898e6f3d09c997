"""Transverse ray aberrations are plotted: spot diagrams and ray fans."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from dolens.analysis.ray_intercepts import RayFans
from dolens.analysis.spot_diagram import SpotDiagram
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.plotting.style import (
    DASHES,
    PAGE,
    SMALL,
    draw_title,
    legend_below,
    number_text,
    ruled_axes,
    spectral_colour,
    wavelength_handles,
)

_PANEL = 1.75
# Fields of an overlaid diagram stand side by side, up to so many in a row.
_COLUMNS = 4
# Above a panel: its numbers, and in the first row the wavelength too.
_HEADING = 0.15
# A chief ray farther out than the light by this factor is left out.
_CHIEF_REACH = 1.3
# The last of the compared columns gets a magnified copy where its light reaches less than this
# share of the common scale.
_LOST = 0.4
# Beside more columns than these a heading has room for one number alone.
_FEW = 3


def spots_figure(
    spots: SpotDiagram, overlaid: bool = False, title: str | None = "Spot diagram"
) -> Figure:
    """Plot ray intercepts, in µm from the centroid of all light of the field.

    A row for every field and a column for every wavelength, all of one scale, so that colours that
    land apart are seen apart; or a panel for every field with all wavelengths in it.  The circle is
    Airy's, about the spot's centroid (overlaid: that of the reference or nearest wavelength); the
    cross is the chief ray of the reference wavelength, where it is near the light.  Above each
    panel stand the RMS radius and the largest distance of a ray from the centroid.  A wavelength
    of weight zero is drawn as the others, and counts in neither number of all wavelengths together.

    Artists carry gids: `spot`, `airy`, `chief`.

    Args:
        spots: the data.
        overlaid: one panel a field.
        title: above all panels.

    Returns:
        A figure; panels that no light reaches say so.
    """
    fields, waves = len(spots.fields), len(spots.wavelengths)
    drawn = _Drawn(spots)
    rows = math.ceil(fields / _COLUMNS) if overlaid else fields
    columns = math.ceil(fields / rows) if overlaid else waves
    panel = min(_PANEL, (PAGE - 0.75) / columns)
    lines = 0 if title is None else title.count("\n") + 1
    figure = Figure(
        figsize=(
            max(panel * columns + 0.75, 4.6),
            (panel + (0.5 if overlaid else 2.0 * _HEADING)) * rows + 0.8 + 0.18 * lines,
        ),
        layout="constrained",
    )
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for field in range(fields):
        label = field_label(spots.fields[field], spots.field_unit)
        if overlaid:
            axes = grid[divmod(field, columns)]
            drawn.field(axes, field)
            axes.set_title(f"{label}\n{drawn.numbers(field)}", fontsize=SMALL)
            continue
        for wave in range(waves):
            axes = grid[field, wave]
            drawn.spot(axes, field, wave)
            heading = f"{float(spots.wavelengths[wave]):g} nm\n" if field == 0 else ""
            axes.set_title(heading + drawn.numbers(field, wave), fontsize=SMALL)
        grid[field, 0].set_ylabel(f"{label}\ny (µm)", fontsize=SMALL + 1)
    _label(grid, fields, drawn.reach, overlaid)
    _legend(figure, spots, overlaid)
    draw_title(figure, title)
    return figure


def spots_comparison_figure(
    compared: Mapping[str, SpotDiagram],
    title: str | None = "Spot diagrams",
    labels: Sequence[str] | None = None,
) -> Figure:
    """Plot the spots of several lenses, or of one before and after, on one scale.

    A row for every field, a column for every lens, all wavelengths in one panel.  Where the last
    column's light takes little of the common scale, another column shows it magnified, and says by
    how much.

    Args:
        compared: name → spots; of the same fields.
        title: above all panels.
        labels: one a field, where its place differs between the lenses; None: its place.

    Raises:
        InputError: nothing to compare, or numbers of fields that differ.
    """
    diagrams = list(compared.values())
    if not diagrams or any(d.fields.shape != diagrams[0].fields.shape for d in diagrams):
        raise InputError(
            "spots_comparison_figure needs spots of the same fields, of one lens or more"
        )
    drawn = {name: _Drawn(spots) for name, spots in compared.items()}
    reach = max(d.reach for d in drawn.values())
    columns = [(name, one, reach) for name, one in drawn.items()]
    last, own = list(drawn.items())[-1]
    if own.reach < _LOST * reach:
        columns.append((f"{last}, ×{number_text(reach / own.reach, 2)}", own, own.reach))
    fields = len(diagrams[0].fields)
    panel = min(_PANEL, (PAGE - 1.1) / len(columns))
    lines = 0 if title is None else title.count("\n") + 1
    size = (
        max(panel * len(columns) + 1.1, 4.6),
        (panel + 2.0 * _HEADING) * fields + 0.8 + 0.18 * lines,
    )
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(fields, len(columns), squeeze=False, sharex="col")
    for column, (name, one, half) in enumerate(columns):
        for field in range(fields):
            axes = grid[field, column]
            one.field(axes, field)
            heading = f"{name}\n" if field == 0 else ""
            numbers = one.numbers(field, short=len(columns) > _FEW)
            axes.set_title(heading + numbers, fontsize=SMALL)
        _label(grid[:, [column]], fields, half, False)
    for row, field in enumerate(diagrams[0].fields):
        label = labels[row] if labels else field_label(field, diagrams[0].field_unit)
        grid[row, 0].set_ylabel(f"{label}\ny (µm)", fontsize=SMALL + 1)
        for axes, (_, _, half) in zip(grid[row, 1:], columns[1:], strict=True):
            axes.tick_params(labelleft=half != reach)
    _legend(figure, diagrams[0], True)
    draw_title(figure, title)
    return figure


class _Drawn:
    """Draws the spots of one diagram, in µm about the centroid of each field."""

    def __init__(self, spots: SpotDiagram) -> None:
        self.spots = spots
        centre = spots.polychromatic_centroid
        self.points = (1e3 * (spots.intercepts - centre[:, None, None])).numpy()
        self.middles = (1e3 * (spots.centroid - centre[:, None])).numpy()
        airy = 1e3 * spots.airy_radius.numpy()
        # That of an afocal lens has no size.
        self.airy = np.where(np.isfinite(airy), airy, 0.0)
        self.nearest = int((spots.wavelengths - spots.reference_wavelength).abs().argmin())
        rings = np.abs(self.middles).max(-1) + self.airy
        light = max(_largest(self.points), _largest(rings))
        chief = (1e3 * (spots.chief - centre)).numpy()
        self.chief = np.where(np.abs(chief) <= _CHIEF_REACH * light, chief, np.nan)
        # From the centre to the edge of a panel, µm.
        self.reach = 1.08 * max(light, _largest(self.chief)) or 1.0

    def field(self, axes: Axes, field: int) -> None:
        """Draw all wavelengths of a field, the widest first, so that none hides another."""
        for wave in self.spots.rms[field].nan_to_num(0.0).argsort(descending=True).tolist():
            self._points(axes, field, wave)
        self._marks(axes, self.chief[field], np.zeros(2), self.airy[self.nearest])

    def spot(self, axes: Axes, field: int, wave: int) -> None:
        """Draw one wavelength of a field."""
        self._points(axes, field, wave)
        self._marks(axes, self.chief[field], self.middles[field, wave], self.airy[wave])

    def numbers(self, field: int, wave: int | None = None, short: bool = False) -> str:
        """Return the RMS radius and, unless `short`, the largest distance from the centroid, for a
        heading.
        """
        if wave is None:
            rms = float(self.spots.polychromatic_rms[field])
            counts = (self.spots.where.weights > 0.0).numpy()
            far = _largest(np.linalg.norm(self.points[field, counts], axis=-1))
        else:
            rms = float(self.spots.rms[field, wave])
            far = 1e3 * float(self.spots.geo[field, wave])
        if math.isnan(rms):
            return "no light passes"
        if short:
            return f"RMS {number_text(1e3 * rms)} µm"
        return f"RMS {number_text(1e3 * rms)}, max {number_text(far)} µm"

    def _points(self, axes: Axes, field: int, wave: int) -> None:
        axes.plot(
            *self.points[field, wave].T,
            linestyle="none",
            marker="o",
            markersize=1.1,
            markeredgewidth=0.0,
            color=spectral_colour(float(self.spots.wavelengths[wave])),
            gid="spot",
            zorder=3,
            rasterized=self.points[field, wave].shape[0] > 500,
        )

    @staticmethod
    def _marks(axes: Axes, chief: np.ndarray, middle: np.ndarray, radius: float) -> None:
        if radius > 0.0 and np.isfinite(middle).all():
            look: dict[str, Any] = {
                "fill": False,
                "edgecolor": "black",
                "linewidth": 0.8,
                "zorder": 4,
            }
            axes.add_patch(Circle(tuple(middle), radius, gid="airy", **look))
        if np.isfinite(chief).all():
            style: dict[str, Any] = {"markersize": 6, "markeredgewidth": 0.8, "color": "black"}
            axes.plot(*chief, marker="+", linestyle="none", gid="chief", zorder=5, **style)


def _largest(values: np.ndarray) -> float:
    """Return the largest finite size, 0 where there is none."""
    return float(np.nanmax(np.abs(values), initial=0.0))


def _label(grid: np.ndarray, fields: int, half: float, overlaid: bool) -> None:
    for number, axes in enumerate(grid.flat):
        if overlaid and number >= fields:
            axes.set_visible(False)
            above = grid.flat[number - grid.shape[1]]
            above.tick_params(labelbottom=True)
            above.set_xlabel("x (µm)", fontsize=SMALL + 1)
        axes.set(xlim=(-half, half), ylim=(-half, half), box_aspect=1.0)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(4, steps=(1, 2, 5, 10)))
        ruled_axes(axes)
    for axes in grid[-1]:
        axes.set_xlabel("x (µm)", fontsize=SMALL + 1)
    if overlaid:
        for axes in grid[:, 0]:
            axes.set_ylabel("y (µm)", fontsize=SMALL + 1)


def _legend(figure: Figure, spots: SpotDiagram, overlaid: bool) -> None:
    style: dict = {"linestyle": "none", "markersize": 6, "markeredgewidth": 0.8, "color": "black"}
    handles: Sequence[Line2D] = [
        *(_dots(spots) if overlaid else ()),
        Line2D([], [], marker="o", markerfacecolor="none", label="Airy disc", **style),
        Line2D([], [], marker="+", label="chief ray", **style),
    ]
    legend_below(figure, handles, 5)


def _dots(spots: SpotDiagram) -> list[Line2D]:
    handles = wavelength_handles(spots.wavelengths)
    for handle in handles:
        handle.set(linestyle="none", marker="o", markersize=4)
    return handles


_HEIGHT = 1.45


def ray_fans_figure(
    fans: RayFans, title: str | None = "Ray fans", pupil: float | None = None
) -> Figure:
    """Plot one row for every field: the tangential fan at the left, the sagittal one at the right.

    All panels have one scale, in µm; lines end where rays no longer pass.

    Args:
        fans: the data.
        title: above all panels.
        pupil: the part of the stop's semi-diameter whose rays count elsewhere; what lies beyond it
            is shaded.  None: all of it.
    """
    rows = len(fans.fields)
    figure = Figure(figsize=(PAGE, _HEIGHT * rows + 1.3), layout="constrained")
    grid = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True)
    # The numbers at both ends of neighbouring axes stay apart.
    figure.set_layout_engine("constrained", wspace=0.06)
    coordinate = fans.coordinate.numpy()
    both = (fans.tangential_um.numpy(), fans.sagittal_um.numpy())
    reach = max(float(np.nanmax(np.abs(fan), initial=0.0)) for fan in both) or 1.0
    for row, field in enumerate(fans.fields):
        for axes, fan in zip(grid[row], both, strict=True):
            axes.axhline(0.0, color="0.6", linewidth=0.7, zorder=1)
            axes.axvline(0.0, color="0.6", linewidth=0.7, zorder=1)
            if pupil is not None and pupil < 1.0:
                for side in (-1.0, 1.0):
                    axes.axvspan(side * pupil, side, color="0.92", linewidth=0.0, zorder=0)
            for number, (line, wavelength) in enumerate(
                zip(fan[row], fans.wavelengths, strict=True)
            ):
                axes.plot(
                    coordinate,
                    line,
                    color=spectral_colour(float(wavelength)),
                    linestyle=DASHES[number % len(DASHES)],
                    linewidth=1.3,
                    gid="fan",
                    zorder=3,
                )
            axes.set(
                xlim=(-1.0, 1.0),
                xticks=(-1.0, -0.5, 0.0, 0.5, 1.0),
                ylim=(-1.08 * reach, 1.08 * reach),
            )
            ruled_axes(axes)
            if np.isnan(fan[row]).all():
                axes.text(0.0, 0.5 * reach, "no light passes", ha="center", fontsize=SMALL)
        label = field_label(field, fans.field_unit)
        grid[row, 0].set_ylabel(f"{label}\naberration (µm)", fontsize=SMALL + 1)
    for axes, name, along in zip(
        (grid[0, 0], grid[0, 1]), ("tangential: y", "sagittal: x"), "yx", strict=True
    ):
        axes.set_title(name, fontsize=SMALL + 1)
        below = grid[-1, 0 if along == "y" else 1]
        below.set_xlabel(f"{along} on the stop / semi-diameter", fontsize=SMALL + 1)
    handles = wavelength_handles(fans.wavelengths)
    for number, handle in enumerate(handles):
        handle.set_linestyle(DASHES[number % len(DASHES)])
    legend_below(figure, handles, 5)
    draw_title(figure, title)
    return figure
