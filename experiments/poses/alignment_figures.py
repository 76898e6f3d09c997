"""The figure of elements named, and of errors of their poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.moments import Pixels
from dolens.experiments.poses.alignment_result import COLUMNS, Alignment
from dolens.plotting.style import (
    DASHES,
    PAGE,
    SMALL,
    TITLE,
    colours,
    draw_title,
    log_ticks,
    ruled_axes,
)

_PANELS = (("tilt", slice(0, 2), "°"), ("decentre", slice(2, 4), "µm"))


@dataclass(frozen=True)
class Setup:
    """Describes the simulated measurement, for titles and lines.

    Attributes:
        lens: its name and aperture.
        fields: the number of fields.
        photons: photons of each spot.
        pixels: pixels of the sensor; None: an ideal one.
        sensor: the parts of the sensor's place that are unknown.
    """

    lens: str
    fields: int
    photons: float
    pixels: Pixels | None
    sensor: Sequence[str]


def alignment_figure(found: Alignment, setup: Setup) -> Figure:
    """Draw elements misaligned against elements named, and errors beside their bounds.

    Where the place of the sensor is unknown, its own errors are beside them.
    """
    unknown = bool(setup.sensor)
    figure = Figure(figsize=(PAGE, 6.4), layout="constrained")
    grid = figure.subplots(2, 2).flatten()
    _confusion(grid[0], found)
    for axes, (name, columns, unit) in zip(grid[1:], _PANELS, strict=False):
        _errors(axes, found, name, columns, unit, unknown)
    if unknown:
        _sensor_errors(grid[3], found, setup.sensor)
    grid[3].set_visible(unknown)
    for axes, letter in zip(grid, "abcd", strict=True):
        axes.set_title(f"({letter})", loc="left", fontsize=SMALL + 1, fontweight="bold")
    photons = f"{setup.photons:_.0f}".replace("_", "\N{NARROW NO-BREAK SPACE}")
    draw_title(
        figure,
        f"{setup.lens}\n{len(found.element) - 1} misalignments from {setup.fields} fields"
        f", {photons} photons a spot{_sensor(setup)}",
    )
    return figure


def _sensor(setup: Setup) -> str:
    """Return the pixels and the unknown parts of their place, for the title."""
    pixels, unknown = setup.pixels, setup.sensor
    text = ""
    if pixels is not None:
        text = f"\n{1e3 * pixels.pitch:.3g} µm pixels, {pixels.read_noise:.3g} e⁻ read noise"
    if unknown:
        shift, focus = "sensor_x" in unknown, "sensor_distance" in unknown
        what = " and ".join(["shift"] * shift + ["focus"] * focus)
        text += f"{', ' if text else chr(10)}sensor's {what} unknown"
    return text


def _confusion(axes: Axes, found: Alignment) -> None:
    names = found.elements
    count = len(names)
    # The demo is a case of its own, not of the batch.
    pairs = (found.element * count + found.named)[1:]
    table = torch.bincount(pairs, minlength=count * count).reshape(count, count)
    share = table / table.sum(1, keepdim=True).clamp(min=1)
    axes.imshow(share.numpy(), cmap="Blues", vmin=0.0, vmax=1.0)
    for row in range(count):
        for column in range(count):
            pale = float(share[row, column]) > 0.5
            text = str(int(table[row, column]))
            colour = "white" if pale else "black"
            axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=TITLE)
    axes.set_xticks(range(count), names, fontsize=SMALL)
    axes.set_yticks(range(count), names, fontsize=SMALL)
    axes.set_xlabel("element named", fontsize=SMALL + 1)
    axes.set_ylabel("element misaligned", fontsize=SMALL + 1)


def _errors(
    axes: Axes, found: Alignment, name: str, columns: slice, unit: str, sensor_unknown: bool
) -> None:
    errors = found.errors(columns)
    # The expected square of the error's length is the sum of the variances.
    bound = found.bound[:, columns].norm(dim=1)
    known = (found.bound[:, :4] / found.bound_ratio)[:, columns].norm(dim=1)
    batch = torch.arange(len(errors)) > 0
    for number, (element, colour) in enumerate(
        zip(found.elements, colours(len(found.elements)), strict=True)
    ):
        mine = batch & (found.element == number)
        if not bool(mine.any()):
            continue
        _spread(axes, errors[mine], bound[mine], colour, element, DASHES[number % 2 * 3])
        if sensor_unknown:
            median = float(known[mine].median())
            axes.axvline(median, color=colour, linewidth=1.0, linestyle="--")
    _finish(axes, f"error of the {name} ({unit})", sensor_unknown)


def _sensor_errors(axes: Axes, found: Alignment, sensor: Sequence[str]) -> None:
    """Draw the errors of all elements together: the length across the axis, and along it."""
    pose = len(COLUMNS)
    difference = (found.found - found.true)[1:, pose:]
    bound = found.bound[1:, pose:]
    along = torch.tensor([name == "sensor_distance" for name in sensor])
    for chosen, colour, name in ((~along, "0.2", "shift"), (along, "0.6", "focus")):
        if bool(chosen.any()):
            errors = difference[:, chosen].norm(dim=1)
            _spread(axes, errors, bound[:, chosen].norm(dim=1), colour, name)
    _finish(axes, "error of the sensor's place (µm)", False)


def _spread(
    axes: Axes, errors: Tensor, bound: Tensor, colour: str, label: str, dashes: object = "-"
) -> None:
    """Draw how many of (K,) errors are below each, and the median of their bounds."""
    ordered = errors.sort().values.clamp(min=1e-12)
    share = 100.0 * torch.arange(1, len(ordered) + 1) / len(ordered)
    axes.plot(
        ordered.numpy(), share.numpy(), color=colour, linestyle=dashes, linewidth=1.5, label=label
    )
    axes.axvline(float(bound.median()), color=colour, linewidth=1.0, linestyle=":")


def _finish(axes: Axes, label: str, known: bool) -> None:
    axes.plot([], [], color="0.4", linewidth=1.0, linestyle=":", label="bound on the RMS")
    if known:
        axes.plot([], [], color="0.4", linewidth=1.0, linestyle="--", label="with the sensor known")
    axes.set_xscale("log")
    axes.set_ylim(0.0, 101.0)
    axes.set_xlabel(label, fontsize=SMALL + 1)
    axes.set_ylabel("share of misalignments (%)", fontsize=SMALL + 1)
    ruled_axes(axes)
    log_ticks(axes.xaxis)
    # Below the axes: lines of bounds cross all of them.
    axes.legend(
        frameon=False, fontsize=SMALL, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2
    )
