"""How many of the lenses that are made are good enough."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.plotting.style import SMALL, TITLE, colours, ruled_axes


def yield_figure(
    series: Mapping[str, Sequence[float] | Tensor],
    nominal: float | None = None,
    limit: float | None = None,
    title: str | None = "Yield",
) -> Figure:
    """The share of lenses whose RMS spot radius is no larger than the abscissa.

    Lenses that fail (not finite) count among all, and are never good enough.

    Args:
        series: label → RMS spot radii (N,), µm, of lenses of one kind.
        nominal: µm, of the lens without errors, a dotted line; None for none.
        limit: µm, still good enough, a dashed line; the legend then has every share within it.
        title: above.

    Raises:
        InputError: there are no series, or one is empty.
    """
    radii = {
        label: torch.as_tensor(values).detach().cpu().double().flatten().numpy()
        for label, values in series.items()
    }
    if not radii or not all(map(len, radii.values())):
        raise InputError("yield_figure needs series with at least one lens each")
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    finite = [values[np.isfinite(values)] for values in radii.values()]
    marks = [mark for mark in (nominal, limit) if mark is not None]
    highest = max([*(float(part.max(initial=0.0)) for part in finite), *marks], default=1.0)
    lowest = min([*(float(part.min(initial=highest)) for part in finite), *marks])
    margin = 0.04 * (highest - lowest) or 0.04 * highest or 1.0
    right = highest + margin
    for (label, values), good, colour in zip(
        radii.items(), finite, colours(len(radii)), strict=True
    ):
        ordered = np.sort(good)
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(values)
        # From nothing, in a step at every lens, on to the edge.
        x = np.concatenate([ordered[:1], ordered, [right]])
        y = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
        if limit is not None:
            label = f"{label}: {100.0 * np.mean(values <= limit):.3g} %"
        axes.plot(x, y[-len(x) :], color=colour, linewidth=1.5, drawstyle="steps-post", label=label)
    if nominal is not None:
        axes.axvline(nominal, color="0.4", linewidth=1.1, linestyle=":", label="nominal")
    if limit is not None:
        text = f"limit {limit:.4g} µm"
        axes.axvline(limit, color="black", linewidth=1.1, linestyle="--", label=text)
    axes.set(xlim=(lowest - margin, right), ylim=(0.0, 101.0))
    axes.set_xlabel("RMS spot radius (µm)", fontsize=SMALL + 1)
    axes.set_ylabel("share of lenses (%)", fontsize=SMALL + 1)
    ruled_axes(axes)
    axes.legend(frameon=False, fontsize=SMALL, loc="lower right")
    if title:
        axes.set_title(title, fontsize=TITLE)
    return figure
