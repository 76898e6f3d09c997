"""The benchmark as a picture: time of each lens and backend with its error, and the ratio."""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from benchmarks.results import Row
from benchmarks.tracing import FORWARD, GRADIENT
from dolens.plotting.style import PALETTE, SMALL, TITLE, open_axes

_PARTS = (FORWARD, GRADIENT)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Save the figure: a column for each lens; rows of time, of time with gradient, of ratio."""
    rows = [row for row in rows if row.part in _PARTS and not row.failed]
    lenses = list(dict.fromkeys(row.lens for row in rows))
    if not lenses:
        return
    figure = Figure(figsize=(3.6 * len(lenses) + 1.2, 9.6), layout="constrained")
    grid = figure.subplots(3, len(lenses), squeeze=False, sharey="row")
    for column, lens in enumerate(lenses):
        mine = [row for row in rows if row.lens == lens]
        for place, part in enumerate(_PARTS):
            _bars(grid[place][column], [row for row in mine if row.part == part])
        _ratios(grid[2][column], mine)
        grid[0][column].set_title(lens.replace("_", " "), fontsize=TITLE)
    for place, part in enumerate(_PARTS):
        times = [row.value for row in rows if row.part == part]
        if times:
            grid[place][0].set_ylim(0.5 * min(times), 8.0 * max(times))
        grid[place][0].set_ylabel(f"{part}\nns per ray and surface", fontsize=SMALL + 1)
    grid[2][0].set_ylabel("reference's time / kernels' time", fontsize=SMALL + 1)
    lines, names = grid[2][0].get_legend_handles_labels()
    if lines:
        options = {"loc": "outside lower center", "ncols": 4, "frameon": False}
        figure.legend(lines, names, fontsize=SMALL, **options)
    most = max(row.threads for row in rows)
    figure.suptitle(
        f"Time with {most} threads and its quartiles, at the most rays; below each bar's number, "
        "the largest error against the float64 reference (* against rays of 28 digits)",
        fontsize=TITLE,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _bars(axes: Axes, rows: list[Row]) -> None:
    if not rows:
        return
    threads, count = max(r.threads for r in rows), max(r.rays for r in rows)
    rows = [r for r in rows if r.threads in (threads, 0) and r.rays == count]
    rows.sort(key=lambda r: (r.dtype, r.device, r.backend != "reference"))
    names = list(dict.fromkeys((r.device, r.backend) for r in rows))
    for place, row in enumerate(rows):
        colour = PALETTE[names.index((row.device, row.backend)) % len(PALETTE)]
        spread = [[row.value - row.low], [row.high - row.value]]
        axes.bar(place, row.value, color=colour, width=0.7, yerr=spread, capsize=3)
        error = "" if math.isnan(row.error) else _error(row)
        axes.annotate(
            f"{row.value:.3g}\n{error}",
            (place, row.high),
            textcoords="offset points",
            xytext=(0, 4),
            ha="center",
            fontsize=SMALL,
        )
    labels = [
        f"{r.backend}{'' if r.device == 'cpu' else ' on ' + r.device}\n{r.dtype}" for r in rows
    ]
    axes.set_xticks(range(len(rows)), labels)
    axes.set_yscale("log")
    open_axes(axes)


def _error(row: Row) -> str:
    if row.error == 0.0:  # the float64 reference itself
        golden = row.part == FORWARD and not math.isnan(row.golden_mm)
        return f"{row.golden_mm:.0e} mm*" if golden else ""
    return f"{row.error:.0e} mm" if row.error_unit == "mm" else f"{row.error:.0e}"


def _ratios(axes: Axes, rows: list[Row]) -> None:
    """Lines over the number of rays: colour for the precision, dashes for the gradient."""
    rows = [r for r in rows if r.backend != "reference" and not math.isnan(r.ratio)]
    keys = list(dict.fromkeys((r.part, r.dtype, r.threads, r.device) for r in rows))
    colours = {"float32": PALETTE[0], "float64": PALETTE[1]}
    for part, dtype, threads, device in keys:
        line = [
            r
            for r in rows
            if (r.part, r.dtype, r.threads, r.device) == (part, dtype, threads, device)
        ]
        line.sort(key=lambda r: r.rays)
        where = device if device != "cpu" else f"{threads} thread{'s' if threads > 1 else ''}"
        axes.errorbar(
            [r.rays for r in line],
            [r.ratio for r in line],
            [[r.ratio - r.ratio_low for r in line], [r.ratio_high - r.ratio for r in line]],
            color=colours[dtype],
            linestyle="-" if part == FORWARD else "--",
            marker="o" if threads > 1 else "s",
            markerfacecolor=colours[dtype] if threads > 1 else "white",
            markersize=4,
            linewidth=1,
            capsize=2,
            label=f"{part}, {dtype}, {where}",
        )
    axes.set_xscale("log")
    axes.set_xlabel("rays", fontsize=SMALL + 1)
    axes.set_yscale("log")
    axes.set_yticks([1, 2, 5, 10, 20, 50, 100, 200], [1, 2, 5, 10, 20, 50, 100, 200], minor=False)
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.3)
    open_axes(axes)
