"""The figure of errors of poses over their bounds, case by case."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.plotting.style import SMALL, TITLE, colours, open_axes


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
    figure = Figure(figsize=(7.6, 1.2 + 0.75 * len(errors)), layout="constrained")
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
                alpha=0.6,
                label=f"fit {fit}" if row == 0 else None,
            )
        shares = [100.0 * float((every < times).double().mean()) for times in (1.0, 2.0)]
        axes.annotate(
            f"{shares[0]:.0f} %, {shares[1]:.0f} %",
            (1.01, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=SMALL,
        )
    axes.set_xscale("symlog", linthresh=3.0)
    axes.set_yticks(range(len(errors)), [case.replace("_", " ") for case in errors])
    axes.invert_yaxis()
    axes.set_xlabel("error over bound (Cramér–Rao); at the right: within one, within two")
    axes.legend(frameon=False, fontsize=SMALL, loc="lower left", ncols=len(names))
    axes.set_title(title, fontsize=TITLE)
    open_axes(axes)
    return figure
