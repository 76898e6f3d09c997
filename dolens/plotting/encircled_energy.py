"""Encircled energy is plotted against the radius."""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.special import j0, j1

from dolens.analysis.encircled_energy import EncircledEnergy
from dolens.analysis.spot_diagram import AIRY
from dolens.optics.fields import field_label
from dolens.plotting.style import PAGE, SMALL, ordered_colours, ruled_axes
from dolens.plotting.titles import draw_title


def encircled_energy_figure(
    with_diffraction: EncircledEnergy | None = None,
    geometric: EncircledEnergy | None = None,
    title: str | None = "Encircled energy",
) -> Figure:
    """Plot the share of light within a radius of the centroid, a colour a field.

    Curves with diffraction are solid and those of rays dashed.  The thin black curve is that of a
    perfect circular pupil, 1 - J₀² - J₁² (Born and Wolf, section 8.5.2).

    Args:
        with_diffraction: None to leave it out.
        geometric: of the same fields; None to leave it out.
        title: above the axes.
    """
    given = [curves for curves in (with_diffraction, geometric) if curves is not None]
    figure = Figure(figsize=(PAGE, 4.0), layout="constrained")
    axes = figure.add_subplot()
    reach = max((float(curves.radii_um[-1]) for curves in given), default=1.0)
    handles = []
    for curves in given:
        solid = curves is with_diffraction
        shades = ordered_colours(len(curves.fields))
        for number, (field, colour) in enumerate(zip(curves.fields, shades, strict=True)):
            label = field_label(field, curves.field_unit)
            line = curves.energy[number].numpy()
            alone = with_diffraction is not None and not with_diffraction.diffraction[number]
            dark = bool(np.isnan(line).all())
            if dark or alone:
                label += " (no light passes)" if dark else " (rays alone)"
            # Rays alone are drawn once.
            if solid or not alone:
                own: dict[str, Any] = {
                    "linestyle": "-" if solid else "--",
                    "linewidth": 1.6 if solid else 1.1,
                }
                axes.plot(curves.radii_um, line, color=colour, gid="energy", zorder=3, **own)
            if curves is given[0]:
                handles.append(Line2D([], [], color=colour, linewidth=1.6, label=label))
    if given and math.isfinite(given[0].airy_radius_um):
        radius = np.linspace(0.0, reach, 400)
        x = math.pi * AIRY * radius / given[0].airy_radius_um
        style: dict[str, Any] = {"color": "black", "linewidth": 0.9}
        axes.plot(radius, 1.0 - j0(x) ** 2 - j1(x) ** 2, zorder=2, gid="perfect", **style)
        handles.append(Line2D([], [], label="perfect lens, axis", **style))
    if len(given) > 1:
        grey: dict[str, Any] = {"color": "0.35"}
        handles.append(Line2D([], [], linewidth=1.6, label="with diffraction", **grey))
        handles.append(Line2D([], [], linewidth=1.1, linestyle="--", label="rays", **grey))
    axes.set(xlim=(0.0, reach), ylim=(0.0, 1.02))
    axes.set_xlabel("radius from the centroid (µm)", fontsize=SMALL + 1)
    axes.set_ylabel("share of light", fontsize=SMALL + 1)
    ruled_axes(axes)
    axes.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        frameon=False,
        fontsize=SMALL,
    )
    draw_title(figure, title)
    return figure
