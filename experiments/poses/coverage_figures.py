"""The figure of errors of poses over their bounds, case by case."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.plotting.style import (
    PAGE,
    SMALL,
    colours,
    draw_axes_title,
    legend_below,
    number_text,
    open_axes,
)


def coverage_figure(
    errors: Mapping[str, Mapping[str, Tensor]], names: Sequence[str], title: str
) -> Figure:
    """Draw a row for each case: every error over its bound, in a colour for each fit.

    One bound and two are shaded; at the right are the shares of errors within them.

    Args:
        errors: case → fit → errors over their bounds.
        names: all fits, also those that no case has.
        title: the title.
    """
    figure = Figure(figsize=(PAGE, 1.7 + 0.7 * len(errors)), layout="constrained")
    axes = figure.add_subplot()
    for times, shade in ((2.0, "0.93"), (1.0, "0.86")):
        axes.axvspan(-times, times, color=shade, zorder=0)
    for row, fits in enumerate(errors.values()):
        every = torch.cat([off.flatten() for off in fits.values()]).abs()
        for fit, found in fits.items():
            off, place = found.flatten(), names.index(fit)
            level = row + 0.5 * ((place + 0.5) / len(names) - 0.5)
            axes.plot(
                off,
                torch.full_like(off, level),
                ".",
                color=colours(len(names))[place],
                markersize=3,
                markeredgewidth=0.0,
                alpha=0.6,
                label=f"fit {fit}" if row == 0 else None,
            )
        shares = [100.0 * float((every < times).double().mean()) for times in (1.0, 2.0)]
        axes.annotate(
            f"{shares[0]:.0f} % | {shares[1]:.0f} %",
            (1.01, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=SMALL,
        )
    axes.set_xscale("symlog", linthresh=3.0)
    axes.set_yticks(range(len(errors)), [case.replace("_", " ") for case in errors])
    axes.set_ylim(len(errors) - 0.5, -0.5)
    axes.set_xlabel("error over Cramér–Rao bound (no unit)", fontsize=SMALL + 1)
    axes.annotate(
        "within\n±1 | ±2",
        (1.01, 1.0),
        xycoords="axes fraction",
        va="bottom",
        fontsize=SMALL,
    )
    draw_axes_title(axes, title)
    open_axes(axes)
    reach = max(abs(limit) for limit in axes.get_xlim())
    powers = [10.0**power for power in range(1, 9) if 10.0**power <= reach]
    ticks = [-p for p in reversed(powers)] + [-2.0, -1.0, 0.0, 1.0, 2.0] + powers
    axes.set_xticks(ticks, [number_text(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, 6, labels, 2.0)
    return figure
