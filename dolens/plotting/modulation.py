"""The modulation transfer function is plotted against frequency."""

import math

from matplotlib.figure import Figure

from dolens.analysis.modulation_transfer import Modulation
from dolens.plotting.style import SMALL, TITLE, colours, field_label, ruled_axes


def modulation_figure(mtf: Modulation, title: str | None = "Geometric MTF") -> Figure:
    """Plot contrast against frequency: tangential solid, sagittal dotted, the diffraction limit
    dashed.

    Args:
        mtf: the data.
        title: above the axes.

    Returns:
        A figure; fields that no light reaches are named so in the legend.
    """
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    frequency = mtf.frequencies.numpy()
    limit = {"color": "black", "linewidth": 1.1, "linestyle": "--"}
    axes.plot(frequency, mtf.diffraction_limit.numpy(), label="diffraction limit", **limit)
    shades = colours(len(mtf.fields))
    for number, (field, colour) in enumerate(zip(mtf.fields, shades, strict=True)):
        label = field_label(field, mtf.field_unit)
        if math.isnan(float(mtf.tangential[number, 0])):
            axes.plot([], [], color=colour, label=f"{label} (no light passes)")
            continue
        # On the axis of a centred lens the two coincide.
        axes.plot(
            frequency,
            mtf.tangential[number].numpy(),
            color=colour,
            linewidth=1.5,
            label=f"{label} tangential",
        )
        axes.plot(
            frequency,
            mtf.sagittal[number].numpy(),
            color=colour,
            linewidth=1.5,
            linestyle=":",
            label=f"{label} sagittal",
        )
    axes.set(xlim=(frequency.min(), frequency.max()), ylim=(0.0, 1.02))
    axes.set_xlabel("frequency (cycles/mm)", fontsize=SMALL + 1)
    axes.set_ylabel("modulation", fontsize=SMALL + 1)
    ruled_axes(axes)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=SMALL)
    if title:
        axes.set_title(title, fontsize=TITLE)
    return figure
