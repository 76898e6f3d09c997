"""A fit of parameters is plotted: its course by iteration, and its covariance as a corner plot."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import (
    MINUS,
    PAGE,
    PALETTE,
    SMALL,
    draw_title,
    legend_below,
    line_styles,
    number_text,
    ruled_axes,
    value_and_error,
)

# Up to here each iteration is worth a dot.
_FEW = 40
# Losses that change by a larger factor get logarithmic axes.
_WIDE = 2.0


def convergence_figure(
    loss: Sequence[float] | Mapping[str, Sequence[float]],
    values: Mapping[str, tuple[Sequence[float], str]],
    stages: Sequence[tuple[str, int]],
    truth: Mapping[str, float] | None = None,
    title: str | None = None,
    loss_label: str = "loss",
) -> Figure:
    """Plot the loss above the parameters; vertical lines separate the stages, labelled by their
    optimizers.

    Parameters whose truth is known are shown by the size of their errors on logarithmic axes, the
    others by their values, those of one unit in the same axes.

    Args:
        loss: one value after each of n iterations; what is not positive leaves gaps.  Where stages
            have losses of their own: name → such values, NaN where another one counts; each has
            axes of its own.
        values: name → (n values, their unit).
        stages: optimizer and number of iterations of each, n in all.
        truth: name → value in the parameter's unit, where it is known.
        title: above.
        loss_label: of the loss's axis, where there is one loss.

    Raises:
        InputError: numbers of values and iterations that differ.
    """
    count = sum(length for _, length in stages)
    losses = dict(loss) if isinstance(loss, Mapping) else {loss_label: loss}
    for name, found in (
        *(("loss", one) for one in losses.values()),
        *((name, found) for name, (found, _) in values.items()),
    ):
        if len(found) != count or not count:
            raise InputError(f"{name}: {len(found)} values for {count} iterations of the stages")
    truth = truth or {}
    panels: dict[tuple[bool, str], dict[str, Sequence[float]]] = {}
    for name, (found, unit) in values.items():
        known = name in truth
        shown = [abs(value - truth[name]) for value in found] if known else found
        panels.setdefault((known, unit), {})[name] = shown
    figure = Figure(figsize=(PAGE, 4.0), layout="constrained")
    heights = [1.0] * len(losses) + [1.2] * len(panels)
    figure.set_figheight(1.0 + 1.45 * sum(heights))
    grid = figure.subplots(len(heights), 1, squeeze=False, sharex=True, height_ratios=heights)[:, 0]
    numbers = range(1, count + 1)
    style = {"linewidth": 1.4, "marker": "o" if count <= _FEW else None, "markersize": 3}
    for axes, (name, found) in zip(grid, losses.items(), strict=False):
        axes.plot(numbers, found, color="black", **style)
        positive = [value for value in found if value > 0.0]
        if positive and max(positive) > _WIDE * min(positive):
            axes.set_yscale("log", nonpositive="mask")
        axes.set_ylabel(name, fontsize=SMALL + 1)
    for axes, ((known, unit), lines) in zip(grid[len(losses) :], panels.items(), strict=True):
        for (name, found), look in zip(lines.items(), line_styles(len(lines)), strict=True):
            axes.plot(numbers, found, label=name, **look, **style)
        if known:
            axes.set_yscale("log", nonpositive="mask")
        printed = "°" if unit == "deg" else unit
        axes.set_ylabel(
            f"|error| ({printed})" if known else f"value ({printed})", fontsize=SMALL + 1
        )
        axes.legend(frameon=False, fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for axes in grid:
        ruled_axes(axes)
    _part(list(grid), stages)
    grid[-1].set_xlabel("iteration", fontsize=SMALL + 1)
    grid[-1].xaxis.set_major_locator(MaxNLocator(integer=True, steps=(1, 2, 5, 10), min_n_ticks=1))
    grid[-1].set_xlim(0.5, count + 0.5)
    figure.align_ylabels()
    draw_title(figure, title)
    return figure


def _part(grid: Sequence[Axes], stages: Sequence[tuple[str, int]]) -> None:
    """Draw lines between the stages, halfway from iteration to iteration, and the optimizers'
    names.
    """
    start = 0
    for number, (optimizer, length) in enumerate(stages):
        if number:
            for axes in grid:
                axes.axvline(start + 0.5, color="0.4", linewidth=0.8, linestyle=(0, (4, 3)))
        grid[0].text(
            start + 0.5 + 0.5 * length,
            1.02,
            optimizer,
            transform=grid[0].get_xaxis_transform(),
            ha="center",
            va="bottom",
            color="0.3",
            fontsize=SMALL,
        )
        start += length


_SIGMAS = (1.0, 2.0)
# Axes reach this far, in σ; further where points or the truth are, up to the second number.
_REACH, _FURTHEST = 2.6, 6.0
_CELL = 1.25
# Cells larger than this have room for three numbers.
_ROOMY = 1.0
# Inches beside and below the cells, for labels.
_BESIDE, _BELOW = 0.75, 1.1
# Letters on colours of stronger correlations are white.
_DARK = 0.8
# Units of σ below 0.1 of them are divided by 1000.
_THOUSANDTHS = {"mm": "µm", "deg": "mdeg", "°": "mdeg"}


@torch.no_grad()
def corner_figure(
    covariance: Tensor,
    labels: Sequence[str],
    units: Sequence[str],
    centre: Tensor | None = None,
    points: Tensor | None = None,
    truth: Tensor | None = None,
    title: str | None = None,
) -> Figure:
    """Draw ellipses of 1σ and 2σ below the diagonal, correlations above it, and each σ on it.

    Axes count from the centre.  Mm and degrees become thousandths where σ is below 0.1 of them.
    The values in the diagonal have the digits that σ allows.

    Args:
        covariance: (P, P), in the products of the units.
        labels: P names.
        units: P of them, such as `mm` or `deg`.
        centre: (P,), values in the middle of the ellipses, written in the diagonal; None: zero,
            and nothing is written.
        points: (M, P), estimates, drawn under the ellipses.
        truth: (P,), a cross; what is not finite is not drawn.

    Returns:
        A figure.  In pairs whose truth is more than 6σ off there is no cross, and the title says
        so.

    Raises:
        InputError: shapes that do not fit, or variances that are not positive and finite.
    """
    matrix = torch.as_tensor(covariance).detach().cpu().double()
    count = len(labels)
    middle = torch.zeros(count) if centre is None else torch.as_tensor(centre)
    shapes = {"covariance": matrix.shape == (count, count), "units": len(units) == count}
    shapes["centre"] = middle.shape == (count,)
    shapes["truth"] = truth is None or truth.shape == (count,)
    shapes["points"] = points is None or (points.ndim == 2 and points.shape[1] == count)
    for name, fits in shapes.items():
        if not fits or not count:
            raise InputError(f"corner plot: {name} does not fit {count} labels")
    sigma = matrix.diagonal().sqrt()
    if not (bool(matrix.isfinite().all()) and bool((sigma > 0.0).all())):
        raise InputError("corner plot: variances must be positive, and all numbers finite")
    scaled = [_unit(float(s), unit) for s, unit in zip(sigma, units, strict=True)]
    factor = torch.tensor([f for f, _ in scaled], dtype=torch.float64)
    shift = middle.detach().cpu().double()
    dots = np.empty((0, count))
    if points is not None:
        dots = ((points.detach().cpu().double() - shift) * factor).numpy()
    cross = np.full(count, np.nan)
    if truth is not None:
        cross = ((truth.detach().cpu().double() - shift) * factor).numpy()
    spread = (sigma * factor).numpy()
    far = np.abs(cross) > _FURTHEST * spread
    reach = _limits(dots, np.where(far, np.nan, cross), spread)

    cell = min(_CELL, (PAGE - _BESIDE) / count)
    figure = Figure(figsize=(cell * count + _BESIDE, cell * count + _BELOW), layout="constrained")
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    grid = figure.subplots(count, count, squeeze=False)
    scaled_covariance = (matrix * torch.outer(factor, factor)).numpy()
    correlations = (matrix / torch.outer(sigma, sigma)).numpy()
    for row in range(count):
        for column in range(count):
            axes = grid[row, column]
            pair = [column, row]
            if column > row:
                _correlation(axes, correlations[row, column])
            elif column == row:
                value = None if centre is None else float(shift[row])
                _deviation(axes, labels[row], value, float(sigma[row]), units[row], cell)
            else:
                shown = scaled_covariance[np.ix_(pair, pair)]
                _pair(axes, shown, dots[:, pair], cross[pair], reach[pair], cell > _ROOMY)
            _ticks(axes, row, column, count)
            if row == count - 1 and column < row:
                axes.set_xlabel(
                    _axis_label(labels[column], scaled[column][1], cell), fontsize=SMALL - 1
                )
            if column == 0 and row > 0:
                name = _axis_label(labels[row], scaled[row][1], cell)
                axes.set_ylabel(name, fontsize=SMALL - 1)
    figure.align_labels()
    # A cross takes two.
    crosses = int((np.isfinite(cross) & ~far).sum()) > 1
    handles = _handles(len(dots), crosses)
    legend_below(figure, handles, 4)
    if far.any():
        beyond = ", ".join(label for label, out in zip(labels, far, strict=True) if out)
        beyond = "all" if far.all() else beyond
        note = f"truth more than {_FURTHEST:g}σ off, not drawn: {beyond}"
        title = f"{title}\n{note}" if title else note
    draw_title(figure, title)
    return figure


def _unit(sigma: float, unit: str) -> tuple[float, str]:
    """Return the factor by which numbers are multiplied to be shown, and their unit then."""
    if sigma < 0.1 and unit in _THOUSANDTHS:
        return 1e3, _THOUSANDTHS[unit]
    return 1.0, unit


def _limits(dots: np.ndarray, cross: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return half the length of each axis, (P,)."""
    reach = _REACH * spread
    others = np.abs(np.concatenate([dots, cross[None]]))
    found = 1.1 * np.nan_to_num(others, nan=0.0, posinf=0.0).max(0)
    return np.maximum(reach, np.minimum(found, 1.1 * _FURTHEST * spread))


def _pair(
    axes: Axes,
    covariance: np.ndarray,
    dots: np.ndarray,
    cross: np.ndarray,
    reach: np.ndarray,
    roomy: bool,
) -> None:
    """Draw two parameters, the first along x; where there is no room, zero has no number."""
    values, vectors = np.linalg.eigh(covariance)
    lengths = np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    if len(dots):
        axes.plot(*dots.T, ".", color="0.55", markersize=4, markeredgewidth=0, zorder=1)
    for sigmas, width in zip(_SIGMAS, (1.4, 1.0), strict=True):
        outline = Ellipse(
            (0.0, 0.0),
            2.0 * sigmas * lengths[1],
            2.0 * sigmas * lengths[0],
            angle=angle,
            facecolor="none",
            edgecolor=PALETTE[0],
            linewidth=width,
            zorder=2,
        )
        axes.add_patch(outline)
    if np.isfinite(cross).all() and (np.abs(cross) <= reach).all():
        axes.plot(*cross[:, None], "+", color=PALETTE[1], markersize=8, markeredgewidth=1.5)
    axes.set_xlim(-reach[0], reach[0])
    axes.set_ylim(-reach[1], reach[1])
    for axis, length in ((axes.xaxis, reach[0]), (axes.yaxis, reach[1])):
        # A round number either side, far enough from the ends that labels stay within the axes.
        power = 10.0 ** np.floor(np.log10(0.8 * length))
        step = power * max(factor for factor in (1, 2, 5) if factor * power <= 0.8 * length)
        axis.set_ticks([-step, 0.0, step], [f"{MINUS}{step:g}", "0" if roomy else "", f"{step:g}"])


def _correlation(axes: Axes, correlation: float) -> None:
    """Write a correlation on a background coloured by its value."""
    axes.set_facecolor(colormaps["RdBu_r"](0.5 + 0.35 * correlation))
    # As many digits as tell it from ±1, and no more than four.
    left = 1.0 - abs(correlation)
    digits = 2 if left > 0.005 else 4
    text = f"{correlation:+z.{digits}f}".replace("-", MINUS)
    if left < 5e-5:
        text = "> +0.9999" if correlation > 0.0 else f"< {MINUS}0.9999"
    axes.text(
        0.5,
        0.5,
        text,
        color="white" if abs(correlation) > _DARK else "black",
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=SMALL,
    )


def _deviation(
    axes: Axes, label: str, value: float | None, sigma: float, unit: str, cell: float
) -> None:
    """Write a parameter's name, value and standard deviation."""
    if value is None:
        factor, shown = _unit(sigma, unit)
        text = f"{label}\nσ = {number_text(factor * sigma, 2)}{_spaced(shown)}"
    else:
        number, error = value_and_error(value, sigma)
        text = f"{_wrapped(label, cell)}\n{number}\n± {error}{_spaced(unit)}"
    axes.text(
        0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=SMALL - 1
    )


def _axis_label(label: str, unit: str, cell: float) -> str:
    return f"{_wrapped(label, cell)}\n({_printed(unit)})"


def _wrapped(label: str, cell: float) -> str:
    """Break a label where it is longer than a cell of so many inches."""
    return textwrap.fill(label, max(round(14.0 * cell), 8))


def _spaced(unit: str) -> str:
    """Return a unit as it follows a number."""
    return "°" if unit == "deg" else f" {_printed(unit)}"


def _printed(unit: str) -> str:
    """Return a unit as it is printed: degrees by their sign."""
    return {"deg": "°", "mdeg": "0.001°"}.get(unit, unit)


def _ticks(axes: Axes, row: int, column: int, count: int) -> None:
    """Label ticks only at the left and at the bottom."""
    axes.tick_params(labelsize=SMALL - 1, length=2)
    axes.spines[:].set_color("0.6")
    if column >= row:
        axes.set(xticks=[], yticks=[])
        return
    if column > 0:
        axes.tick_params(labelleft=False)
    if row < count - 1:
        axes.tick_params(labelbottom=False)


def _handles(points: int, crossed: bool) -> list[Line2D]:
    handles = [Line2D([], [], color=PALETTE[0], linewidth=1.4, label="1σ and 2σ")]
    if points:
        handles.append(Line2D([], [], color="0.55", marker=".", ls="", label=f"{points} estimates"))
    if crossed:
        handles.append(Line2D([], [], color=PALETTE[1], marker="+", ls="", label="truth"))
    return handles
