"""Ray fans are plotted as transverse aberrations across the stop."""

import numpy as np
from matplotlib.figure import Figure

from dolens.analysis.ray_fans import RayFans
from dolens.optics.fields import field_label
from dolens.plotting.legends import legend_below
from dolens.plotting.style import (
    DASHES,
    PAGE,
    SMALL,
    ruled_axes,
    spectral_colour,
    wavelength_handles,
)
from dolens.plotting.titles import draw_title

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
