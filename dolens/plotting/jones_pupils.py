"""Jones pupils are plotted: transmission, diattenuation, retardance, light behind polarisers."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from dolens.diffraction.jones_pupils import JonesPupils
from dolens.optics.fields import field_label
from dolens.plotting.style import PAGE, SMALL, draw_title, number_text

# Dark is none: told apart by colour-blind readers and in grey.
_COLOURS = "cividis"
# Strokes along each side that show axes.
_STROKES = 11
# Less is rounding, and shown as zero; of the largest value, less has no stroke.
_LEAST, _FAINT = 1e-9, 0.02


def jones_pupils_figure(
    own: JonesPupils,
    between: JonesPupils,
    elements: str,
    title: str | None = "Polarisation",
) -> Figure:
    """Show the polarisation of every field over the stop, a row each, at the first wavelength.

    Strokes are along the axis that passes most, and along the fast axis.

    Args:
        own: of the lens without elements.
        between: of the lens with ideal elements.
        elements: in words, above the last column.
        title: above all panels.
    """
    rows = len(own.fields)
    figure = Figure(figsize=(PAGE, 2.35 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, 4, squeeze=False)
    for row, panels in enumerate(grid):
        for axes in panels:
            axes.tick_params(labelsize=SMALL - 1)
            axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), box_aspect=1.0)
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(2, steps=(1, 2, 5, 10)))
        panels[0].set_ylabel(field_label(own.fields[row], own.field_unit), fontsize=SMALL)
        if not bool(own.inside[row, 0].any()):
            for axes in panels:
                axes.set_title("no light passes", fontsize=SMALL)
            continue
        mean = float(own.transmission[row, 0])
        behind = float(between.transmission[row, 0])
        _draw(figure, panels[0], own, row, own.power, f"transmission\nmean {number_text(mean, 4)}")
        for axes, (values, angle), label in (
            (panels[1], own.diattenuation, "diattenuation"),
            (panels[2], own.retardance, "retardance (°)"),
        ):
            most = float(values[row, 0][own.inside[row, 0]].max())
            most = most if most > _LEAST else 0.0
            _draw(figure, axes, own, row, values, f"{label}\nmost {number_text(most, 3)}", 0.0)
            if most > 0.0:
                _strokes(axes, own, row, angle, values > _FAINT * most)
        label = f"{elements}\nmean {number_text(behind, 3)}"
        _draw(figure, panels[3], own, row, between.power, label, 0.0)
    draw_title(figure, title)
    return figure


def _draw(
    figure: Figure,
    axes: Axes,
    pupils: JonesPupils,
    row: int,
    values: Tensor,
    label: str,
    low: float | None = None,
) -> None:
    """Draw a map over the stop; its scale begins at `low`, or at the least value."""
    inside = pupils.inside[row, 0].numpy()
    x, y = (np.nan_to_num(pupils.stop[row, 0, ..., axis].numpy()) for axis in (0, 1))
    shown = np.ma.masked_array(values[row, 0].numpy(), ~inside)
    least = float(shown.min()) if low is None else low
    most = float(shown.max())
    mesh = axes.pcolormesh(
        x,
        y,
        shown,
        cmap=_COLOURS,
        vmin=least,
        vmax=most if most > least + _LEAST else least + 1.0,
        shading="nearest",
        rasterized=True,
        gid="polarisation",
    )
    bar = figure.colorbar(mesh, ax=axes, orientation="horizontal", aspect=14, pad=0.02)
    bar.locator = MaxNLocator(3)
    bar.update_ticks()
    bar.ax.tick_params(labelsize=SMALL - 2)
    axes.set_title(label, fontsize=SMALL)


def _strokes(axes: Axes, pupils: JonesPupils, row: int, angle: Tensor, strong: Tensor) -> None:
    """Draw strokes along angles in degrees, where they are strong."""
    drawn = (pupils.inside & strong)[row, 0].numpy()
    step = max(1, math.ceil(len(drawn) / _STROKES))
    some = (slice(step // 2, None, step), slice(step // 2, None, step))
    kept = drawn[some]
    x, y = (pupils.stop[row, 0, ..., axis].numpy()[some][kept] for axis in (0, 1))
    turned = np.radians(angle[row, 0].numpy()[some][kept])
    style: dict[str, Any] = {"headwidth": 0, "headlength": 0, "headaxislength": 0, "pivot": "mid"}
    style |= {"color": "white", "width": 0.008, "scale": 14, "gid": "axes"}
    axes.quiver(x, y, np.cos(turned), np.sin(turned), **style)
