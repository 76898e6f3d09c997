"""The geometric MTF and the MTF with diffraction are plotted side by side."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dolens.analysis.modulation_transfer import Modulation
from dolens.diffraction.transfer import DiffractionModulation
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.plotting.number_text import number_text
from dolens.plotting.style import PAGE, SMALL, ordered_colours, ruled_axes
from dolens.plotting.titles import draw_title


def modulation_comparison_figure(
    with_diffraction: DiffractionModulation | None = None,
    geometric: Modulation | None = None,
    title: str | None = "Modulation transfer function",
) -> Figure:
    """Plot contrast against frequency, with diffraction at the left and of rays at the right.

    Tangential curves are solid and sagittal ones dashed, a colour a field.  The thin black curve is
    the diffraction limit: at the left that of the field nearest to the axis, of its own pupil; at
    the right that of the paraxial circular pupil.

    Args:
        with_diffraction: None to leave its panel out.
        geometric: of the same fields; None to leave its panel out.
        title: above all.

    Raises:
        InputError: neither is given.
    """
    given = [curves for curves in (with_diffraction, geometric) if curves is not None]
    if not given:
        raise InputError("modulation_comparison_figure needs an MTF of one kind or the other")
    figure = Figure(figsize=(PAGE if len(given) > 1 else 5.2, 3.7), layout="constrained")
    grid = figure.subplots(1, len(given), squeeze=False, sharey=True)[0]
    notes = [""] * len(given[0].fields)
    for axes, curves in zip(grid, given, strict=True):
        name = "rays (geometric)"
        if isinstance(curves, DiffractionModulation):
            name = "with diffraction"
            known = curves.sampling_error[curves.sampling_error.isfinite()]
            if len(known):
                name += f", sampling error {number_text(float(known.max()), 1)}"
            for number, diffraction in enumerate(curves.diffraction):
                notes[number] = "" if diffraction else " (rays alone)"
        _draw(axes, curves)
        axes.set_title(name, fontsize=SMALL + 1)
    dark = np.isnan(given[0].tangential[:, 0].numpy())
    handles = [
        Line2D([], [], color=colour, linewidth=1.6, label=label + note)
        for colour, label, note in zip(
            ordered_colours(len(notes)),
            [field_label(field, given[0].field_unit) for field in given[0].fields],
            [" (no light passes)" if no else note for no, note in zip(dark, notes, strict=True)],
            strict=True,
        )
    ]
    handles += [
        Line2D([], [], color="0.25", linewidth=1.4, label="tangential"),
        Line2D([], [], color="0.25", linewidth=1.4, linestyle="--", label="sagittal"),
        Line2D([], [], color="black", linewidth=0.9, label="diffraction limit"),
    ]
    figure.legend(handles=handles, loc="outside right center", frameon=False, fontsize=SMALL)
    grid[0].set(ylim=(0.0, 1.02))
    grid[0].set_ylabel("modulation", fontsize=SMALL + 1)
    draw_title(figure, title)
    return figure


def _draw(axes: Axes, curves: DiffractionModulation | Modulation) -> None:
    frequency = curves.frequencies.numpy()
    limit = _limit(curves)
    if limit is not None:
        axes.plot(frequency, limit, color="black", linewidth=0.9, gid="limit", zorder=2)
    for number, colour in enumerate(ordered_colours(len(curves.fields))):
        style: dict[str, Any] = {"color": colour, "linewidth": 1.5, "zorder": 3}
        axes.plot(frequency, curves.tangential[number], gid="tangential", **style)
        axes.plot(frequency, curves.sagittal[number], gid="sagittal", linestyle="--", **style)
    axes.set_xlim(frequency.min(), frequency.max())
    axes.set_xlabel("frequency (cycles/mm)", fontsize=SMALL + 1)
    ruled_axes(axes)


def _limit(curves: DiffractionModulation | Modulation) -> np.ndarray | None:
    if isinstance(curves, Modulation):
        return curves.diffraction_limit.numpy()
    known = [
        (float(field.norm()), number)
        for number, field in enumerate(curves.fields)
        if not math.isnan(float(curves.tangential_limit[number, 0]))
    ]
    return curves.tangential_limit[min(known)[1]].numpy() if known else None
