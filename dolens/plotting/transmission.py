"""The light that a lens passes, and that its coatings reflect, is plotted."""

from collections.abc import Mapping

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.analysis.conditions import wavelength_interval
from dolens.analysis.transmission import Transmission, reflectances
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.plotting.style import (
    DASHES,
    PAGE,
    PALETTE,
    SMALL,
    draw_title,
    legend_below,
    ordered_colours,
    ruled_axes,
)

# Degrees of incidence of curves of reflectance.
_ANGLES = (0.0, 15.0, 30.0)
_WAVELENGTHS = 121


def transmission_figure(found: Transmission, title: str | None = "Transmission") -> Figure:
    """Plot the share of light against the wavelength for each field, and the loss of each surface
    and of the glass in front of it, the mean over fields and wavelengths.
    """
    figure = Figure(figsize=(PAGE, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    order = torch.argsort(found.wavelengths)
    waves, fields = found.wavelengths[order], found.fields.tolist()
    for field, share, colour in zip(fields, found.share, ordered_colours(len(fields)), strict=True):
        label = field_label(field, found.field_unit)
        percent = 100.0 * share.detach()[order]
        left.plot(waves, percent, marker="o", markersize=3.0, color=colour, label=label)
    ruled_axes(left)
    left.set_xlabel("wavelength (nm)", fontsize=SMALL + 1)
    left.set_ylabel("light that arrives (%)", fontsize=SMALL + 1)
    _losses(right, found)
    handles, labels = left.get_legend_handles_labels()
    beside, names = right.get_legend_handles_labels()
    legend_below(figure, [*handles, *beside], 5, [*labels, *names])
    draw_title(figure, title)
    return figure


def _losses(axes: Axes, found: Transmission) -> None:
    rows = found.surface_cells()
    at, before = ([float(row[column]) for row in rows] for column in (1, 2))
    places = list(range(len(rows)))
    axes.barh(places, at, height=0.7, color=PALETTE[0], label="at the surface")
    if any(before):
        label = "in the glass in front"
        axes.barh(places, before, left=at, height=0.7, color=PALETTE[1], label=label)
    if not rows:
        axes.text(0.5, 0.5, "nothing is lost", transform=axes.transAxes, ha="center")
    ruled_axes(axes)
    axes.set_yticks(places, [row[0] for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_ylabel("surface", fontsize=SMALL + 1)
    axes.set_xlabel("light that is lost (%)", fontsize=SMALL + 1)


def reflectance_figure(
    lenses: Mapping[str, Lens], title: str | None = "Reflectance of the coatings"
) -> Figure:
    """Plot what coatings reflect of unpolarised light against the wavelength, at 0, 15 and 30
    degrees in front of the surface: the mean over the coated surfaces.

    Args:
        lenses: name → lens with coatings, drawn in colours of their own.
        title: above the axes.
    """
    figure = Figure(figsize=(PAGE, 4.0), layout="constrained")
    axes = figure.subplots()
    for (name, lens), colour in zip(lenses.items(), PALETTE, strict=False):
        low, high = wavelength_interval(lens)
        waves = torch.linspace(low, high, _WAVELENGTHS, dtype=torch.float64)
        for angle, dash in zip(_ANGLES, DASHES, strict=False):
            label = f"{name}, {angle:g}°"
            curve = 100.0 * mean_reflectance(lens, waves, angle)
            axes.plot(waves, curve, color=colour, linestyle=dash, label=label)
    ruled_axes(axes)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("wavelength (nm)", fontsize=SMALL + 1)
    axes.set_ylabel("reflected (%)", fontsize=SMALL + 1)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, len(_ANGLES), labels)
    draw_title(figure, title)
    return figure


@torch.no_grad()
def mean_reflectance(lens: Lens, wavelengths: Tensor, angle: float) -> Tensor:
    """Return the share of unpolarised light that coatings reflect, the mean over the coated
    surfaces, at wavelengths (nm) and an angle of incidence (degrees).
    """
    found = reflectances(lens.system(), wavelengths, (angle,))
    return torch.stack([*found.values()]).mean(0)[:, 0]
