"""Point spread functions are shown as panels, a field each, with axes in µm."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dolens.diffraction.point_spread import PointSpread
from dolens.optics.fields import field_label
from dolens.plotting.number_text import number_text
from dolens.plotting.style import PAGE, SMALL
from dolens.plotting.titles import draw_title

# Lightness grows evenly, for colour-blind readers and in print too.
_COLOURS = "inferno"
_COLUMNS = 4


def point_spread_figure(psf: PointSpread, title: str | None = "Point spread functions") -> Figure:
    """Show the point spread function of every field in its own window, over its own peak.

    Brightness follows the square root of the irradiance, so that rings and flare show.  Above each
    panel stand the field, the Strehl ratio and the sampling error over the peak; `rays alone` where
    the wavefront is too steep for diffraction, or that no light passes.

    Args:
        psf: the data.
        title: above all panels.
    """
    count = len(psf.fields)
    columns = min(count, _COLUMNS)
    rows = math.ceil(count / columns)
    norm = PowerNorm(0.5, 0.0, 1.0)
    width = PAGE if columns > 2 else 1.2 + 2.4 * columns
    size = max(width, 4.2), ((width - 1.2) / columns + 0.7) * rows + 0.6
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for number, axes in enumerate(grid.flat):
        if number >= count:
            axes.set_visible(False)
            continue
        _draw(axes, psf, number, norm)
        axes.set_xlabel("x (µm)" if number + columns >= count else "", fontsize=SMALL + 1)
        axes.set_ylabel("y (µm)" if number % columns == 0 else "", fontsize=SMALL + 1)
    bar = figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=grid, ticks=(0.0, 0.01, 0.1, 0.25, 0.5, 1.0), aspect=30
    )
    bar.ax.set_yticklabels(("0", "0.01", "0.1", "0.25", "0.5", "1"), fontsize=SMALL)
    bar.set_label("irradiance / peak", fontsize=SMALL + 1)
    draw_title(figure, title)
    return figure


def _draw(axes: Axes, psf: PointSpread, number: int, norm: PowerNorm) -> None:
    label = field_label(psf.fields[number], psf.field_unit)
    half = float(psf.half_width_um[number])
    picture = psf.irradiance[number].numpy()
    axes.tick_params(labelsize=SMALL - 1)
    if math.isnan(half):
        axes.set(xticks=[], yticks=[], box_aspect=1.0)
        axes.set_title(f"{label}\nno light passes", fontsize=SMALL)
        return
    peak = float(np.max(picture)) or 1.0
    axes.imshow(
        picture / peak,
        cmap=_COLOURS,
        norm=norm,
        origin="lower",
        extent=(-half, half, -half, half),
        interpolation="nearest",
        gid="psf",
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=(1, 2, 5, 10)))
    strehl = float(psf.strehl_ratio[number])
    quality = "rays alone"
    if psf.diffraction[number]:
        error = 100.0 * float(psf.sampling_error[number])
        quality = f"Strehl ratio {strehl:.2g}\nsampling error {number_text(error, 1)} %"
    axes.set_title(f"{label}\n{quality}", fontsize=SMALL)
