"""Figures of cameras of spectra."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.spectra.reflectances import BANDS
from dolens.plotting.style import PAGE, SMALL, colours, draw_title, spectral_colour
from dolens.sensor.colour import linear_to_srgb

# nm, of the bands that are shown.
_BANDS = (450.0, 550.0, 650.0)
_POINTS = 3
# Pixels at the edges that hold no point.
_EDGE = 4


class Shown(NamedTuple):
    """A test scene as cameras see it.

    Attributes:
        truth: (L, H, W).
        colour: (3, L), to linear sRGB.
        images: camera → image (1, H, W).
        found: camera → spectra (L, H, W).
    """

    truth: Tensor
    colour: Tensor
    images: dict[str, Tensor]
    found: dict[str, Tensor]


def spectra_figure(shown: Shown) -> Figure:
    """Show the scene, and for each camera its image, estimated bands and spectra at points."""
    names = list(shown.found)
    figure = Figure(figsize=(PAGE, 0.5 + 1.02 * (len(names) + 1)), layout="constrained")
    grid = figure.subplots(len(names) + 1, 6, width_ratios=[1, 1, 1, 1, 1, 1.4])
    points = _points(shown)
    rows = {"scene": (None, shown.truth), **{n: (shown.images[n], shown.found[n]) for n in names}}
    shades = colours(_POINTS)
    for number, (name, (image, spectra)) in enumerate(rows.items()):
        row = grid[number]
        rgb = torch.einsum("cl,lhw->chw", shown.colour, spectra)
        row[1].imshow(linear_to_srgb(rgb).permute(1, 2, 0))
        if image is None:
            row[0].set_axis_off()
        else:
            row[0].imshow(image[0], cmap="gray", vmin=0.0, vmax=float(image.quantile(0.995)))
        for axes, band in zip(row[2:5], _BANDS, strict=True):
            axes.imshow(spectra[BANDS.index(band)], cmap="gray", vmin=0.0, vmax=1.0)
        for shade, (y, x) in zip(shades, points, strict=True):
            row[1].plot(x, y, "o", markersize=3.5, color=shade, markeredgecolor="white")
            row[5].plot(BANDS, shown.truth[:, y, x], color=shade, linewidth=1.0)
            if image is not None:
                row[5].plot(BANDS, spectra[:, y, x], "--", color=shade, linewidth=1.0)
        row[5].set_ylim(0.0, 1.1 * max(float(shown.truth[:, y, x].max()) for y, x in points))
        row[5].tick_params(labelsize=SMALL - 2, labelbottom=number == len(names))
        for axes in row[:5]:
            axes.set_xticks([])
            axes.set_yticks([])
        row[1 if image is None else 0].set_ylabel(name.replace("_", "\n"), fontsize=SMALL)
    labels = ["", "RGB", *(f"{band:.0f} nm" for band in _BANDS), "spectra"]
    for axes, label in zip(grid[0], labels, strict=True):
        axes.set_title(label, fontsize=SMALL)
    grid[1, 0].set_title("image", fontsize=SMALL)
    grid[-1, 5].set_xlabel("nm", fontsize=SMALL)
    draw_title(figure, "Spectra from one exposure; lines are true, dashes estimated")
    return figure


def _points(shown: Shown) -> list[tuple[int, int]]:
    """Return row and column of lit pixels whose colours differ most."""
    rgb = torch.einsum("cl,lhw->chw", shown.colour, shown.truth)
    chosen = rgb.sum(0) > 0.5 * rgb.sum(0).mean()
    for edge in (chosen[:_EDGE], chosen[-_EDGE:], chosen[:, :_EDGE], chosen[:, -_EDGE:]):
        edge.fill_(False)
    lit = chosen.flatten()
    share = (rgb / rgb.sum(0).clamp(min=1e-3)).flatten(1).mT
    found = [int(torch.where(lit, share[:, 0], -1.0).argmax())]
    while len(found) < _POINTS:
        far = torch.cdist(share, share[found]).amin(1)
        found.append(int(torch.where(lit, far, -1.0).argmax()))
    return [divmod(n, rgb.shape[-1]) for n in found]


def functions_figure(functions: Mapping[str, Tensor], relief: Tensor) -> Figure:
    """Show the relief, and the point spread functions of cameras at some wavelengths."""
    chosen = (400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0)
    figure = Figure(figsize=(PAGE, 0.5 + 0.98 * (len(functions) + 1)), layout="constrained")
    grid = figure.subplots(len(functions) + 1, len(chosen))
    for axes in grid.flat:
        axes.set_xticks([])
        axes.set_yticks([])
    for axes in grid[0]:
        axes.set_axis_off()
    if relief.ndim == 2:  # pixels; what the round aperture hides is never learned
        at = [torch.linspace(-1.0, 1.0, n) for n in relief.shape]
        relief = torch.where(torch.hypot(at[0][:, None], at[1]) < 1.0, relief, torch.nan)
    shown = grid[0, 0].imshow(relief if relief.ndim == 2 else relief[None], cmap="viridis")
    bar = figure.colorbar(shown, cax=grid[0, 1].inset_axes([-0.1, 0.1, 0.1, 0.8]))
    bar.set_label("relief, nm", fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL - 2)
    for row, (name, found) in zip(grid[1:], functions.items(), strict=True):
        row[0].set_ylabel(name.replace("_", "\n"), fontsize=SMALL)
        for axes, band in zip(row, chosen, strict=True):
            # The square root, so that halos are seen.
            axes.imshow(found[BANDS.index(band)].clamp(min=0.0).sqrt(), cmap="magma")
    for axes, band in zip(grid[1], chosen, strict=True):
        axes.set_title(f"{band:.0f} nm", fontsize=SMALL, color=spectral_colour(band))
    draw_title(figure, "Relief and point spread functions, square roots")
    return figure
