"""The history of a design is plotted: merit and damping by iteration."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterMathtext, LogLocator, MaxNLocator, NullLocator

from dolens.errors import InputError
from dolens.plotting.style import PALETTE, SMALL, ruled_axes
from dolens.plotting.ticks import log_ticks
from dolens.plotting.titles import draw_axes_title

_FEW = 40
# The height of the merit's axes over that of the damping's.
_MERIT_HEIGHT = 5.0


def history_figure(
    merit: Sequence[float],
    damping: Sequence[float] | None = None,
    iterations: Sequence[float] | None = None,
    title: str | None = "History of the design",
    merit_label: str = "merit",
    damping_label: str = "damping",
) -> Figure:
    """Plot merit against iteration, on a logarithmic axis, with the damping in a strip below.

    Values that are not positive leave gaps.

    Args:
        merit: one value an iteration.
        damping: as many, or None for no axes below.
        iterations: as many; None counts from zero.
        title: above.
        merit_label: of the axis, with its unit.
        damping_label: of the axis below, with its unit.

    Raises:
        InputError: the numbers of values differ.
    """
    numbers = range(len(merit)) if iterations is None else iterations
    for name, values in (("damping", damping), ("iterations", numbers)):
        if values is not None and len(values) != len(merit):
            raise InputError(f"{len(merit)} values of merit and {len(values)} of {name}")
    rows = [(merit_label, merit, PALETTE[0])]
    if damping is not None:
        rows.append((damping_label, damping, "0.45"))
    ratios = (_MERIT_HEIGHT, 1.0)[: len(rows)]
    figure = Figure(figsize=(5.0, 3.2 + 0.6 * (len(rows) - 1)), layout="constrained")
    grid = figure.subplots(len(rows), 1, squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    marker = "o" if len(merit) <= _FEW else None
    for axes, (label, values, colour) in zip(grid, rows, strict=True):
        axes.plot(numbers, values, color=colour, linewidth=1.4, marker=marker, markersize=3)
        axes.set_yscale("log", nonpositive="mask")
        axes.set_ylabel(label, fontsize=SMALL + 1)
        ruled_axes(axes)
        log_ticks(axes.yaxis)
    if damping is not None:
        # A strip has room for a few numbers only.
        grid[1].yaxis.set_major_locator(LogLocator(numticks=3))
        grid[1].yaxis.set_minor_locator(NullLocator())
        grid[1].yaxis.set_major_formatter(LogFormatterMathtext())
    grid[-1].set_xlabel("iteration", fontsize=SMALL + 1)
    grid[-1].xaxis.set_major_locator(MaxNLocator(integer=True, steps=(1, 2, 5, 10)))
    figure.align_ylabels()
    draw_axes_title(grid[0], title)
    return figure
