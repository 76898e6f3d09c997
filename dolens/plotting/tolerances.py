"""Tolerances are plotted: Jacobians as matrices, worst offenders as bars, yields as curves, and
how good lenses of a series are.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import (
    PAGE,
    PALETTE,
    SMALL,
    TITLE,
    draw_title,
    legend_below,
    number_text,
    open_axes,
    plain_text,
)

_CELL_WIDTH, _CELL_HEIGHT = 0.26, 0.14
# Inches for the labels of rows, and for those of columns with titles and colour bars.
_LEFT, _BOTTOM = 1.4, 2.3
# Matrices that are wider than a page by this factor are squeezed; wider ones are stacked.
_SQUEEZE = 1.4
# White is zero: of numbers of both signs, and of positive ones.
_BOTH_SIGNS, _POSITIVE = "RdBu_r", "Reds"
# Two standard deviations of a share of n lenses, √(p·(1 - p)/n), are drawn as a band.
_BAND = 2.0
_SINGULAR = {"thicknesses.": "thickness ", "sources.": "source ", "planes.": "plane "}
# A half-range as `Tolerances.label` writes it: number, and unit with the blank before it.
_TOLERANCE = re.compile(r"± ([\d.e+-]+)(.*)")


def matrix_figure(
    panels: Mapping[str, tuple[Tensor, Sequence[str]]],
    rows: Sequence[str],
    groups: Sequence[tuple[str, int]] = (),
    title: str | None = None,
) -> Figure:
    """Draw matrices, red where positive and blue where negative, each on its own scale.

    They stand side by side where a page is wide enough for them, else one above the other.

    Args:
        panels: title with unit → matrix (R, C) and names of its columns.
        rows: R labels, shared by all panels.
        groups: name and number of rows of each block of rows, from the top; lines part them.
        title: above all.

    Returns:
        A figure; a colour bar under every panel says its scale.
    """
    for name, (matrix, columns) in panels.items():
        if matrix.shape != (len(rows), len(columns)):
            raise InputError(
                f"panel '{name}': {len(rows)} rows and {len(columns)} columns are named, "
                f"the matrix is {tuple(matrix.shape)}"
            )
    widths = [max(len(columns), 5) * _CELL_WIDTH for _, columns in panels.values()]
    beside = sum(widths) + 0.35 * len(panels) + _LEFT <= _SQUEEZE * PAGE
    tall = len(rows) * _CELL_HEIGHT + _BOTTOM
    if beside:
        size = (min(sum(widths) + 0.35 * len(panels) + _LEFT, PAGE), tall + 0.3)
    else:
        size = (min(max(widths) + 0.35 + _LEFT, PAGE), len(panels) * tall + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    shape: dict[str, Any] = {"width_ratios": widths} if beside else {}
    grid = figure.add_gridspec(*((1, len(panels)) if beside else (len(panels), 1)), **shape)
    for place, (name, (matrix, columns)) in enumerate(panels.items()):
        axes = figure.add_subplot(grid[0, place] if beside else grid[place, 0])
        named = place == 0 or not beside
        values = matrix.detach().cpu().double().numpy()
        limit = float(np.abs(values).max()) or 1.0
        signed = bool((values < -1e-3 * limit).any()) or not values.any()
        image = axes.imshow(
            values,
            cmap=_BOTH_SIGNS if signed else _POSITIVE,
            vmin=-limit if signed else 0.0,
            vmax=limit,
            aspect="auto",
            interpolation="none",
        )
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=SMALL - 1)
        axes.set_yticks(range(len(rows)), rows if named else [], fontsize=SMALL - 1)
        axes.tick_params(length=0)
        axes.set_xticks(np.arange(1, len(columns)) - 0.5, minor=True)
        axes.grid(True, which="minor", axis="x", color="0.85", linewidth=0.4)
        axes.tick_params(which="minor", length=0)
        _part(axes, groups, named)
        # `pad` is a share of the matrix's height; the gap is to be the same for few rows and many.
        gap = 0.16 / (len(rows) * _CELL_HEIGHT)
        bar = figure.colorbar(
            image, ax=axes, orientation="horizontal", pad=gap, shrink=0.9, aspect=30
        )
        bar.set_label(name, fontsize=SMALL)
        bar.ax.tick_params(labelsize=SMALL - 1)
        bar.ax.locator_params(nbins=5 if len(columns) > 8 else 3)
        bar.outline.set_linewidth(0.4)
    draw_title(figure, title)
    return figure


def yield_figure(
    panels: Mapping[str, Mapping[str, Tensor]],
    nominal: Mapping[str, float],
    title: str | None = None,
) -> Figure:
    """Plot the share of lenses within an RMS radius, against the radius.

    Args:
        panels: what the radius is → label → RMS of every lens, mm, ascending, infinite where a
            lens fails.  Labels in pairs share a colour: the second of each is dashed.
        nominal: kind of radius → that of the designed lens, mm.
        title: above all.
    """
    figure = Figure(figsize=(max(PAGE * len(panels) / 2.0, 4.6), 4.2), layout="constrained")
    for place, (name, series) in enumerate(panels.items()):
        axes = figure.add_subplot(1, len(panels), place + 1)
        far = 0.0
        for turn, (label, radii) in enumerate(series.items()):
            shares = (torch.arange(len(radii)).double() + 1.0) / len(radii)
            axes.plot(
                *(1e3 * radii, 100.0 * shares),
                label=label,
                color=PALETTE[turn // 2],
                linestyle="--" if turn % 2 else "-",
                linewidth=1.1 if turn % 2 else 2.2,
                alpha=1.0 if turn % 2 else 0.6,
            )
            if not turn % 2:
                spread = _BAND * (shares * (1.0 - shares) / len(radii)).sqrt()
                low, high = ((100.0 * (shares + s * spread)).clamp(0, 100) for s in (-1.0, 1.0))
                there = radii.isfinite()
                axes.fill_between(
                    *(1e3 * radii[there], low[there], high[there]),
                    color=PALETTE[turn // 2],
                    alpha=0.18,
                    linewidth=0.0,
                )
            finite = radii[radii.isfinite()]
            if len(finite):
                far = max(far, 1e3 * float(finite[min(int(0.998 * len(radii)), len(finite) - 1)]))
        look: dict[str, Any] = {"color": "0.3", "linewidth": 0.9, "linestyle": ":"}
        axes.axvline(1e3 * nominal[name], label="as designed, refocused", **look)
        near = 1e3 * nominal[name]
        if far > near:
            axes.set_xlim(near - 0.1 * (far - near), far)
        axes.set_ylim(0.0, 101.0)
        axes.set_yticks([0, 20, 40, 60, 80, 100])
        axes.set_xlabel(f"{name} (µm)", fontsize=SMALL + 1)
        axes.set_ylabel("lenses within (%)" if place == 0 else "", fontsize=SMALL + 1)
        axes.grid(True, axis="y", color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        open_axes(axes)
        handles = axes.get_legend_handles_labels()[0]
    band = Patch(facecolor="0.5", alpha=0.3, label="±2σ of the share, by the number of lenses")
    legend_below(figure, [*handles, band], 3 if len(panels) > 1 else 2)
    draw_title(figure, title)
    return figure


def offenders_figure(
    names: Sequence[str],
    shares: Sequence[float],
    increases: Mapping[str, Sequence[float]],
    title: str | None = None,
) -> Figure:
    """Draw bars, with the worst offender on top.

    Args:
        names: with their tolerances, the worst first.
        shares: of the average rise of the mean square radius, 0 to 1.
        increases: label → growth of the RMS radius by a whole tolerance, mm.
        title: above all.
    """
    figure = Figure(figsize=(PAGE, 0.25 * len(names) + 1.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(names))
    left.barh(places, 100.0 * np.asarray(shares), height=0.7, color=PALETTE[0])
    left.set_xlabel("share of the average rise of RMS²,\nrefocused (%)", fontsize=SMALL + 1)
    height = 0.8 / max(len(increases), 1)
    for turn, (label, values) in enumerate(increases.items()):
        right.barh(
            places + (turn - 0.5 * (len(increases) - 1)) * height,
            1e3 * np.asarray(values),
            height=0.95 * height,
            color=PALETTE[turn],
            hatch="////" if turn % 2 else None,
            edgecolor="white",
            linewidth=0.0,
            label=label,
        )
    right.set_xlabel("growth of the RMS radius\nby the whole tolerance (µm)", fontsize=SMALL + 1)
    handles, labels = right.get_legend_handles_labels()
    figure.legend(
        handles, labels, frameon=False, fontsize=SMALL, loc="outside lower right", ncols=len(labels)
    )
    left.set_yticks(places, names)
    left.set_ylim(len(names) - 0.4, -0.6)
    for axes in (left, right):
        open_axes(axes)
        axes.grid(True, axis="x", color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
    draw_title(figure, title)
    return figure


def parameter_label(name: str) -> str:
    """Return the label of a parameter in figures: `front tilt x`, `curvature 3`, `gradient 1 r2`,
    `thickness 1`, `source 0 z`, and `sources z` of all sources (`sources.*.z`).
    """
    first, *rest = name.split(".")
    if first == "surfaces":
        number, name, *term = rest
        return " ".join((name, number, *term))
    label = name.removeprefix("elements.").replace(".*.", " ")
    for many, one in _SINGULAR.items():
        label = label.replace(many, one)
    return label.replace(".", " ").replace("_", " ")


def tolerance_label(name: str, tolerance: str) -> str:
    """Return a parameter with its tolerance: `front tilt x, ±0.05°` of `± 0.05°`.

    Args:
        name: of the parameter.
        tolerance: as `Tolerances.label` writes it.
    """
    match = _TOLERANCE.fullmatch(tolerance)
    assert match is not None  # as `Tolerances.label` writes it
    number, unit = match.groups()
    return f"{plain_text(parameter_label(name))}, ±{number_text(float(number), 4)}{unit}"


def _part(axes: Axes, groups: Sequence[tuple[str, int]], named: bool) -> None:
    """Draw lines between blocks of rows, and their names at the left."""
    row = 0
    for name, count in groups:
        if row:
            axes.axhline(row - 0.5, color="0.2", linewidth=0.9)
        if named:
            axes.annotate(
                name,
                (0.0, row + 0.5 * (count - 1)),
                xycoords=("axes fraction", "data"),
                xytext=(-84, 0),
                textcoords="offset points",
                ha="center",
                va="center",
                fontsize=TITLE,
                fontweight="bold",
            )
        row += count


def made_front_figure(
    arms: Mapping[str, Mapping[float, tuple[float, float, float]]],
    drawn: Mapping[str, float],
    title: str,
) -> Figure:
    """Draw the PSNR of the worst tenth of the lenses over the factor of their tolerances.

    Args:
        arms: name of a camera → factor → worst decile and its interval, dB.
        drawn: name → PSNR of its lens as drawn, dB.
        title: of the figure.
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    factors: Sequence[float] = []
    for number, (name, curve) in enumerate(arms.items()):
        factors = sorted(curve)
        middle, low, high = zip(*(curve[factor] for factor in factors), strict=True)
        colour = f"C{number}"
        axes.plot(factors, middle, "o-", color=colour, label=name)
        axes.fill_between(factors, low, high, color=colour, alpha=0.2, linewidth=0.0)
        axes.axhline(drawn[name], color=colour, linestyle=":", label=f"{name}, lens as drawn")
    axes.set_xscale("log")
    axes.set_xticks(factors, [f"{factor:g}" for factor in factors])
    axes.minorticks_off()
    axes.set_xlabel("factor of all tolerances")
    axes.set_ylabel("PSNR of the worst tenth of the lenses, dB")
    above = axes.secondary_xaxis("top", functions=(_reciprocal, _reciprocal))
    above.set_xticks([1.0 / f for f in factors], [f"{1.0 / f:.2g}" for f in factors])
    above.minorticks_off()
    above.set_xlabel("cost of the tolerances, Σ a/t, relative to factor 1")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.suptitle(title, fontsize="medium")
    return figure


def _reciprocal(value: Any) -> Any:
    # Matplotlib asks at zero too, of an axis that has none.
    return 1.0 / np.maximum(value, 1e-9)


def made_lenses_figure(
    scores: Mapping[str, Tensor], drawn: Mapping[str, float], passing: float, title: str
) -> Figure:
    """Draw the share of lenses that reach a PSNR.

    Args:
        scores: name of a series → PSNR of each lens, (N,), dB.
        drawn: name → PSNR of its lens as drawn, dB.
        passing: the least PSNR of a lens that passes, dB.
        title: of the figure.
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, found) in enumerate(scores.items()):
        ascending = found.sort().values
        share = 1.0 - torch.arange(len(ascending)) / len(ascending)
        colour = f"C{number}"
        axes.step(ascending, 100.0 * share, where="pre", color=colour, label=name)
        axes.axvline(drawn[name], color=colour, linestyle=":", label=f"{name}, lens as drawn")
    axes.axvline(passing, color="0.5", linewidth=0.8, label="passes")
    axes.set_xlabel("PSNR of the worst view, dB")
    axes.set_ylabel("lenses that reach it, %")
    axes.set_ylim(0.0, 103.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    axes.set_title(title, fontsize="medium")
    return figure
