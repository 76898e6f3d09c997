"""The course of a search for lenses is plotted: the best so far and the forms, against time."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dolens.errors import InputError
from dolens.plotting.legends import legend_below
from dolens.plotting.style import PALETTE, SMALL, ruled_axes
from dolens.plotting.ticks import log_ticks
from dolens.plotting.titles import draw_axes_title

# Merits that span this ratio are drawn on a logarithmic axis.
_WIDE = 3.0
# Designs beyond this many times the best are no part of the picture.
_FARTHEST = 20.0


def search_course_figure(
    seconds: Sequence[float],
    merits: Sequence[float],
    best: Sequence[float],
    forms: Sequence[int],
    merit_label: str = "merit",
    within: float = 0.25,
    title: str | None = None,
) -> Figure:
    """Plot every design that a search found, the best so far, and below it the number of forms.

    Args:
        seconds: (N,), s, wall time at which each design was found, ascending.
        merits: (N,), of the designs.
        best: (N,), the least merit so far.
        forms: (N,), number of different forms so far within a share of the best so far.
        merit_label: of the axis, with its unit.
        within: that share.
        title: above all.

    Raises:
        InputError: there are no designs, or the numbers of values differ.
    """
    counts = {len(seconds), len(merits), len(best), len(forms)}
    if len(counts) > 1 or not len(seconds):
        raise InputError(
            f"course of a search: {len(seconds)} times, {len(merits)} merits, {len(best)} best and "
            f"{len(forms)} forms; allowed: as many of each, and one at least"
        )
    figure = Figure(figsize=(5.6, 4.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
    upper.plot(
        seconds, merits, "o", color="0.6", markersize=2.6, markeredgewidth=0.0, label="designs"
    )
    # Designs that were known at once make one step.
    steps = dict(zip(seconds, zip(best, forms, strict=True), strict=True))
    times = [*steps, max(seconds)]
    least, number = (list(values) for values in zip(*steps.values(), strict=True))
    upper.step(
        *(times, [*least, best[-1]]),
        where="post",
        color=PALETTE[1],
        linewidth=1.4,
        label="best so far",
    )
    near = [merit for merit in merits if merit <= _FARTHEST * best[-1]]
    if best[-1] > 0.0 and max(near) > _WIDE * best[-1]:
        upper.set_yscale("log")
        upper.set_ylim(0.85 * best[-1], 1.2 * max(near))
        log_ticks(upper.yaxis)
    else:
        upper.set_ylim(best[-1] - 0.08 * (max(near) - best[-1] or best[-1]), None)
    upper.set_ylabel(merit_label, fontsize=SMALL + 1)
    lower.step(times, [*number, forms[-1]], where="post", color=PALETTE[0], linewidth=1.4)
    lower.yaxis.set_major_locator(MaxNLocator(integer=True))
    lower.set_ylim(0.0, 1.1 * max(*number, 1))
    lower.set_xlim(0.0, None)
    lower.set_ylabel(f"forms within {100.0 * within:g} %\nof the best (number)", fontsize=SMALL + 1)
    lower.set_xlabel("wall time (s)", fontsize=SMALL + 1)
    ruled_axes(upper)
    ruled_axes(lower)
    figure.align_ylabels()
    handles, names = upper.get_legend_handles_labels()
    legend_below(figure, handles, 2, names)
    draw_axes_title(upper, title)
    return figure
