"""Point spread functions are shown as panels or colour images, and encircled energy as curves."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from dolens.analysis.encircled_energy import EncircledEnergy
from dolens.analysis.spot_diagram import AIRY
from dolens.diffraction.point_spread import PointSpread
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.plotting.style import (
    PAGE,
    SMALL,
    TITLE,
    draw_title,
    number_text,
    ordered_colours,
    ruled_axes,
    scale_bar,
)
from dolens.sensor.colour import linear_to_srgb

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


_ENERGY = 0.998
_DEPTH_COLUMNS = 4
_PANEL = 2.1
_SMALLEST_WINDOW = 7


@torch.no_grad()
def psf_figure(
    psfs: Tensor, labels: Sequence[str], pixel_pitch_mm: float, title: str | None = None
) -> Figure:
    """Show point spread functions, one panel a depth, in colour and normalised to their own peak.

    All panels show the same square window: one that holds 99.8 % of the light of each function, and
    little more.  It need not be about the middle.

    Args:
        psfs: (depths, 3, K, K), linear light; the channels are shown as red, green and blue.
        labels: one a depth, written above its panel.
        pixel_pitch_mm: for the scale bar.
        title: above all panels.

    Returns:
        A figure.  The number above a panel is its peak in the units of `psfs`: for functions of
        unit sum, the share of a channel's light in its brightest pixel.
    """
    if psfs.ndim != 4 or psfs.shape[1] != 3 or psfs.shape[2] != psfs.shape[3]:
        raise InputError(f"psfs must be (depths, 3, K, K), not {tuple(psfs.shape)}")
    if len(labels) != len(psfs):
        raise InputError(f"{len(psfs)} depths need as many labels, not {len(labels)}")
    psfs = psfs.detach().cpu().double()
    top, left, size = window_of_light(psfs.sum(1))
    window = psfs[..., top : top + size, left : left + size]
    peaks = window.amax((1, 2, 3))
    scale = torch.where(peaks > 0.0, peaks, 1.0).view(-1, 1, 1, 1)
    pictures = linear_to_srgb(window / scale).permute(0, 2, 3, 1).numpy()

    rows = math.ceil(len(psfs) / _DEPTH_COLUMNS)
    columns = math.ceil(len(psfs) / rows)
    panel = min(_PANEL, PAGE / columns)
    note = "each to its own peak, display-encoded (sRGB), not interpolated"
    heading = 0.2 * (2 + (title.count("\n") if title else 0))
    figure = Figure(
        figsize=(max(panel * columns, 5.2), (panel + 0.6) * rows + heading), layout="constrained"
    )
    for number, (picture, label, peak) in enumerate(zip(pictures, labels, peaks, strict=True)):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.imshow(picture, interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{label}\npeak {number_text(float(peak), 2)}", fontsize=SMALL)
        if number == 0:
            scale_bar(axes, size, pixel_pitch_mm)
    draw_title(figure, f"{title}\n{note}" if title else note, TITLE if title else SMALL)
    return figure


def window_of_light(light: Tensor, share: float = _ENERGY) -> tuple[int, int, int]:
    """Return top, left and side of a square that holds a share of each image's light.

    Rows and columns are taken from the side where the least light is, one by one.

    Args:
        light: (N, K, K), none negative.
        share: of the light of each; dark images do not count.
    """
    size = light.shape[-1]
    total = light.sum((-2, -1))
    light = light[total > 0.0] / total[total > 0.0, None, None]
    # Sums over rectangles are differences of these.
    sums = torch.nn.functional.pad(light.cumsum(-2).cumsum(-1), (1, 0, 1, 0))

    def held(box: tuple[int, int, int, int]) -> float:
        top, bottom, left, right = box
        found = sums[:, bottom, right] - sums[:, top, right]
        found = found - sums[:, bottom, left] + sums[:, top, left]
        return float(found.min()) if len(found) else 0.0

    box = (0, size, 0, size)
    while True:
        top, bottom, left, right = box
        smaller = []
        if bottom - top > 1:
            smaller += [(top + 1, bottom, left, right), (top, bottom - 1, left, right)]
        if right - left > 1:
            smaller += [(top, bottom, left + 1, right), (top, bottom, left, right - 1)]
        best = max(smaller, key=held, default=None)
        if best is None or held(best) < share:
            break
        box = best
    if not len(light):
        box = (size // 2, size // 2 + 1, size // 2, size // 2 + 1)
    top, bottom, left, right = box
    # One pixel of dark around, where there is room.
    side = min(max(bottom - top + 2, right - left + 2, min(size, _SMALLEST_WINDOW)), size)

    def start(low: int, high: int) -> int:
        return min(max((low + high - side) // 2, 0), size - side)

    return start(top, bottom), start(left, right), side


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
        from scipy.special import j0, j1  # slow to load, and all of plotting loads this file

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
