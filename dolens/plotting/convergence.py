"""The convergence of a fit is plotted: parameters and loss by iteration."""

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dolens.errors import InputError
from dolens.plotting.style import PAGE, SMALL, line_styles, ruled_axes
from dolens.plotting.titles import draw_title

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
