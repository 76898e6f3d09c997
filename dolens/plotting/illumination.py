"""Relative illumination is plotted against the field."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from dolens.diffraction.illumination import Illumination
from dolens.plotting.field_curves import note_if_empty, scan_label
from dolens.plotting.legends import legend_below
from dolens.plotting.style import PAGE, PALETTE, SMALL, ruled_axes
from dolens.plotting.titles import draw_title


def illumination_figure(
    illumination: Illumination | Sequence[Illumination],
    title: str | None = "Relative illumination",
) -> Figure:
    """Plot irradiance over that on the axis, in percent, with cos⁴ of the field for comparison.

    Args:
        illumination: of one scan, or of several, a panel each.
        title: above all.
    """
    panels = [illumination] if isinstance(illumination, Illumination) else list(illumination)
    figure = Figure(figsize=(PAGE if len(panels) > 1 else 5.4, 3.5), layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axes, curve in zip(grid, panels, strict=True):
        field = curve.scan.coordinate.numpy()
        fourth, relative = 100.0 * curve.cosine_fourth, 100.0 * curve.relative
        style = {"color": "0.5", "linewidth": 1.1, "linestyle": "--"}
        axes.plot(field, fourth, label="cos⁴ of the field", zorder=2, **style)
        style = {"color": PALETTE[0], "linewidth": 1.8, "gid": "illumination"}
        axes.plot(field, relative, label="relative illumination", zorder=3, **style)
        note_if_empty(axes, relative.numpy(), "no light passes on the axis")
        axes.set_xlim(field.min(), field.max())
        axes.set_xlabel(scan_label(curve.scan), fontsize=SMALL + 1)
        ruled_axes(axes)
    top = max([102.0, *(105.0 * float(c.relative.nan_to_num(0.0).max()) for c in panels)])
    grid[0].set_ylim(0.0, top)
    grid[0].set_ylabel("irradiance (% of the axis)", fontsize=SMALL + 1)
    handles, labels = grid[0].get_legend_handles_labels()
    legend_below(figure, handles, 2, labels)
    draw_title(figure, title)
    return figure
