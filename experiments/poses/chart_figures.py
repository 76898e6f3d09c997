"""Figures of a camera's prescription from photographs: marks, intervals and coverage."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.chart import MarkWindows
from dolens.alignment.chart_fit import ChartFit
from dolens.alignment.chart_model import ChartModel
from dolens.experiments.poses.chart_restoration import ARMS
from dolens.experiments.poses.chart_result import FittedSpecimen, restored
from dolens.plotting.captions import plain_text
from dolens.plotting.style import PAGE, SMALL, colours, draw_title, open_axes
from dolens.rendering.psf import bin_rays

# Half the side of what is drawn of a mark, in widths of its spot.
_SEEN = 4.0


def parameter_label(name: str) -> str:
    """Return a label for people: `front tilt x` of `elements.front.tilt_x`."""
    short = name.removeprefix("elements.").replace("thicknesses.", "gap ")
    return short.replace("planes.", "plane ").replace(".", " ").replace("_", " ")


def marks_figure(
    model: ChartModel, windows: MarkWindows, fit: ChartFit, designed: Tensor, title: str
) -> Figure:
    """Draw some marks: photographed, by the fitted model, their difference over the noise, and by
    the design.
    """
    shown = _shown(windows)
    figure = Figure(figsize=(PAGE, 0.55 + 1.65 * len(shown)), layout="constrained")
    grid = figure.subplots(len(shown), 4, squeeze=False)
    landed = model.landed(fit.numbers), model.landed(designed)
    centres, widths = model.spots(fit.numbers, landed[0])
    planned, _ = model.spots(designed, landed[1])
    for row, (photograph, mark) in zip(grid, shown, strict=True):
        half = int(_SEEN * float(widths[photograph, mark]) / windows.pitch) + 2
        x, y = windows.x[photograph, mark], windows.y[photograph, mark]
        part = (
            _part(y, centres[photograph, mark, 1], half),
            _part(x, centres[photograph, mark, 0], half),
        )
        counts = windows.counts[photograph, mark]
        seen = counts[part] - counts.median()
        own = _image(model, fit.numbers, landed[0], x, y, photograph, mark)[part]
        own = own * seen.sum() / own.sum()
        # The design has the mark elsewhere: it is shown as it would be there.
        apart = planned[photograph, mark] - centres[photograph, mark]
        other = _image(model, designed, landed[1], x + apart[0], y + apart[1], photograph, mark)[
            part
        ]
        other = other * seen.sum() / other.sum()
        noise = (own + counts.median().clamp(min=0.0) + windows.read_noise**2).sqrt()
        bright = float(own.max())
        for axes, image, limits, colour in (
            (row[0], seen, (0.0, bright), "viridis"),
            (row[1], own, (0.0, bright), "viridis"),
            (row[2], (seen - own) / noise, (-4.0, 4.0), "RdBu_r"),
            (row[3], other, (0.0, bright), "viridis"),
        ):
            axes.imshow(image.numpy(), vmin=limits[0], vmax=limits[1], cmap=colour, origin="lower")
            axes.set_xticks([])
            axes.set_yticks([])
        row[0].set_ylabel(f"mark {mark + 1}\nphotograph {photograph + 1}", fontsize=SMALL)
    heads = ("photograph", "fitted model", "difference over noise, ±4", "design")
    for axes, head in zip(grid[0], heads, strict=True):
        axes.set_title(head, fontsize=SMALL + 1)
    draw_title(figure, title)
    return figure


def _shown(windows: MarkWindows) -> list[tuple[int, int]]:
    """Return photographs and marks: the first, a middle and the last of each."""
    photographs, marks = windows.counts.shape[:2]
    middle = (photographs // 2, marks // 2)
    pairs = [(0, 0), middle, (photographs // 2, marks - 1), (photographs - 1, 0)]
    return list(dict.fromkeys(pairs))


def _part(middles: Tensor, centre: Tensor, half: int) -> slice:
    """Return the pixels about a place, in a row of pixels' middles (mm)."""
    place = int(((centre - middles[0]) / (middles[1] - middles[0])).round())
    return slice(max(place - half, 0), place + half + 1)


def _image(
    model: ChartModel,
    numbers: Tensor,
    landed: Tensor,
    x: Tensor,
    y: Tensor,
    photograph: int,
    mark: int,
) -> Tensor:
    """Return a mark's light by the model's rays on pixels at x (W,) and y (H,), of any
    brightness.
    """
    points = model.on_sensor(numbers, landed, photograph).points[mark]
    columns = (points[:, 0] - x[0]) / (x[1] - x[0])
    rows = (points[:, 1] - y[0]) / (y[1] - y[0])
    return bin_rays(rows, columns, landed[4, mark], len(y), len(x), 1)


def intervals_figure(fits: Sequence[tuple[int, ChartFit]], title: str) -> Figure:
    """Draw posterior over prior deviations of every parameter, for numbers of photographs."""
    whole = fits[-1][1]
    names = [name for name in whole.prior.names if not name.startswith("planes.")]
    figure = Figure(figsize=(PAGE, 1.2 + 0.19 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    for (count, fit), colour, marker in zip(fits, colours(len(fits)), "osDv^P", strict=False):
        share = dict(
            zip(
                fit.prior.names,
                (fit.standard_errors / fit.prior.deviation).tolist(),
                strict=True,
            )
        )
        axes.plot(
            [share[name] for name in names],
            range(len(names)),
            marker,
            color=colour,
            markersize=4,
            label=f"{count} photograph{'s' if count > 1 else ''}",
        )
    axes.set_yticks(
        range(len(names)), [plain_text(parameter_label(name)) for name in names], fontsize=SMALL
    )
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.axvline(1.0, color="0.6", linewidth=0.8)
    axes.set_xlabel("standard error over the prior's deviation (no unit)", fontsize=SMALL + 1)
    axes.grid(axis="y", color="0.93")
    axes.legend(fontsize=SMALL, loc="lower left")
    open_axes(axes)
    draw_title(figure, title)
    return figure


def coverage_figure(specimens: Sequence[FittedSpecimen], title: str) -> Figure:
    """Draw every error over its standard error, a row for each parameter."""
    names = specimens[0].fit.prior.names
    off = torch.stack([one.off for one in specimens])
    figure = Figure(figsize=(PAGE, 1.2 + 0.17 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    for times, shade in ((2.0, "0.93"), (1.0, "0.86")):
        axes.axvspan(-times, times, color=shade, zorder=0)
    for row in range(len(names)):
        axes.plot(off[:, row], [row] * len(off), ".", color=colours(1)[0], markersize=4, alpha=0.6)
        shares = [100.0 * float((off[:, row].abs() < t).double().mean()) for t in (1.0, 2.0)]
        axes.annotate(
            f"{shares[0]:.0f} % | {shares[1]:.0f} %",
            (1.01, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=SMALL - 1,
        )
    reach = max(3.2, 1.05 * float(off.abs().max()))
    axes.set_xlim(-reach, reach)
    axes.set_yticks(
        range(len(names)), [plain_text(parameter_label(n)) for n in names], fontsize=SMALL - 1
    )
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("error over standard error (no unit)", fontsize=SMALL + 1)
    axes.annotate(
        "within\n±1 | ±2", (1.01, 1.0), xycoords="axes fraction", va="bottom", fontsize=SMALL
    )
    open_axes(axes)
    draw_title(figure, title)
    return figure


def restoration_figure(specimens: Sequence[FittedSpecimen], title: str) -> Figure:
    """Draw what the fitted functions gain against what the true ones do, a point for each camera
    and field.
    """
    psnr = restored(specimens)
    gains = psnr[:, 1:] - psnr[:, :1]
    figure = Figure(figsize=(0.62 * PAGE, 0.6 * PAGE), layout="constrained")
    axes = figure.add_subplot()
    fields = gains.shape[2]
    for field, colour in enumerate(colours(fields)):
        axes.plot(
            gains[:, 1, field],
            gains[:, 0, field],
            "o",
            color=colour,
            markersize=4,
            label=f"field {field + 1}",
        )
    low, high = min(0.0, float(gains.min())), 1.05 * float(gains.max())
    axes.plot([low, high], [low, high], color="0.6", linewidth=0.8)
    axes.set_xlabel(f"gain by the {ARMS[2]} functions over the design's (dB)", fontsize=SMALL + 1)
    axes.set_ylabel(f"gain by the {ARMS[1]} ones (dB)", fontsize=SMALL + 1)
    axes.legend(fontsize=SMALL)
    open_axes(axes)
    draw_title(figure, title)
    return figure
