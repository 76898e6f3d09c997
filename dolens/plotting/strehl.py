"""Strehl ratios are plotted against the field."""

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dolens.analysis.conditions import FieldScan
from dolens.diffraction.strehl import StrehlRatios
from dolens.plotting.field_curves import note_if_empty, scan_label
from dolens.plotting.legends import legend_below
from dolens.plotting.style import PAGE, SMALL, ruled_axes, spectral_colour, wavelength_handles
from dolens.plotting.titles import draw_title

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
