"""The modulation transfer function is plotted against frequency, of rays and with diffraction."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dolens.analysis.modulation_transfer import Modulation
from dolens.diffraction.modulation_transfer import DiffractionModulation
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.plotting.style import (
    PAGE,
    SMALL,
    draw_title,
    legend_below,
    number_text,
    ordered_colours,
    ruled_axes,
)

_DASHES: dict[str, Any] = {"tangential": "-", "sagittal": (0, (1, 1.2))}
# Curves that differ by less are one on paper.
_SAME = 2e-3
# More panels than these have no room for a label each.
_FEW = 3


Curves = Modulation | DiffractionModulation


def modulation_figure(
    mtf: Curves | Mapping[str, Curves],
    title: str | None = "Geometric MTF",
    labels: Sequence[str] | None = None,
) -> Figure:
    """Plot contrast against frequency: tangential solid, sagittal dotted, the diffraction limit
    dashed.

    Several functions of the same fields, as of a lens before and after, stand side by side at one
    scale.  Fields whose curves are the same share one entry of the legend.

    Args:
        mtf: the data, or name → data, the names written above.
        title: above the axes.
        labels: one a field, where its place differs between the panels; None: its place.

    Returns:
        A figure; fields that no light reaches are named so in the legend.
    """
    panels = dict(mtf) if isinstance(mtf, Mapping) else {"": mtf}
    figure = Figure(figsize=(PAGE, 4.0), layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    names = {}
    for axes, (name, found) in zip(grid, panels.items(), strict=True):
        names[name] = _draw(axes, found, labels)
        if name:
            axes.set_title(name, fontsize=SMALL + 1)
    if len(panels) > _FEW:
        # Labels side by side would run into each other.
        for axes in [a for n, a in enumerate(grid) if n != len(panels) // 2]:
            axes.set_xlabel("")
    grid[0].set_ylabel("modulation (contrast)", fontsize=SMALL + 1)
    first = next(iter(panels.values()))
    shades = ordered_colours(len(first.fields))
    grouped = _agreed(list(names.values()))
    handles = [
        Line2D([], [], color=shades[number], linewidth=1.5, label=label)
        for number, label in grouped.items()
    ]
    for label, dashes in _DASHES.items():
        handles.append(Line2D([], [], color="0.3", linestyle=dashes, linewidth=1.5, label=label))
    handles.append(Line2D([], [], color="black", linestyle="--", label="diffraction limit"))
    legend_below(figure, handles, 5)
    draw_title(figure, title)
    return figure


def _draw(axes: Axes, mtf: Curves, names: Sequence[str] | None = None) -> dict[int, list[str]]:
    """Draw one lens; return labels of the fields that share a curve, by the number of the field
    that is drawn.
    """
    frequency = mtf.frequencies.numpy()
    limit: dict[str, Any] = {
        "color": "black",
        "linewidth": 1.1,
        "linestyle": "--",
        "label": "diffraction limit",
    }
    best = _limit(mtf)
    if best is not None:
        axes.plot(frequency, best, **limit)
    labels: dict[int, list[str]] = {}
    shades = ordered_colours(len(mtf.fields))
    for number, (field, colour) in enumerate(zip(mtf.fields, shades, strict=True)):
        label = names[number] if names else field_label(field, mtf.field_unit)
        if math.isnan(float(mtf.tangential[number, 0])):
            labels[number] = [f"{label} (no light passes)"]
            continue
        twin = next((n for n in labels if _alike(mtf, n, number)), None)
        if twin is not None:
            labels[twin].append(label)
            continue
        labels[number] = [label]
        curves = (
            ("tangential", mtf.tangential, _DASHES["tangential"]),
            ("sagittal", mtf.sagittal, _DASHES["sagittal"]),
        )
        for way, curve, dashes in curves:
            axes.plot(
                frequency,
                curve[number].numpy(),
                color=colour,
                linewidth=1.5,
                linestyle=dashes,
                label=f"{label} {way}",
            )
    axes.set(xlim=(frequency.min(), frequency.max()), ylim=(0.0, 1.02))
    axes.set_xlabel("frequency (cycles/mm)", fontsize=SMALL + 1)
    ruled_axes(axes)
    return labels


def _alike(mtf: Curves, one: int, other: int) -> bool:
    pairs = ((curve[one], curve[other]) for curve in (mtf.tangential, mtf.sagittal))
    return all(torch.allclose(a, b, rtol=0.0, atol=_SAME) for a, b in pairs)


def _agreed(labels: list[dict[int, list[str]]]) -> dict[int, str]:
    """Return the labels of a legend that is right for all panels."""
    if all(found == labels[0] for found in labels):
        return {number: ", ".join(shared) for number, shared in labels[0].items()}
    # Where panels join other fields, each field has its own entry; a curve may hide another.
    return {number: shared[0] for found in labels for number, shared in found.items()}


def modulation_comparison_figure(
    with_diffraction: DiffractionModulation | None = None,
    geometric: Modulation | None = None,
    title: str | None = "Modulation transfer function",
) -> Figure:
    """Plot contrast against frequency, with diffraction at the left and of rays at the right, as
    `modulation_figure` does.

    The diffraction limit is at the left that of the field nearest to the axis, of its own pupil; at
    the right that of the paraxial circular pupil.

    Args:
        with_diffraction: None to leave its panel out.
        geometric: of the same fields; None to leave its panel out.
        title: above all.

    Raises:
        InputError: neither is given.
    """
    panels: dict[str, Curves] = {}
    labels = None
    if with_diffraction is not None:
        name = "with diffraction"
        known = with_diffraction.sampling_error[with_diffraction.sampling_error.isfinite()]
        if len(known):
            name += f", sampling error {number_text(float(known.max()), 1)}"
        panels[name] = with_diffraction
        labels = [field_label(f, with_diffraction.field_unit) for f in with_diffraction.fields]
        lit = ~with_diffraction.tangential[:, 0].isnan()
        for number, by_waves in enumerate(with_diffraction.diffraction):
            labels[number] += " (rays alone)" if lit[number] and not by_waves else ""
    if geometric is not None:
        panels["rays (geometric)"] = geometric
    if not panels:
        raise InputError("modulation_comparison_figure needs an MTF of one kind or the other")
    return modulation_figure(panels, title, labels)


def _limit(curves: Curves) -> np.ndarray | None:
    if isinstance(curves, Modulation):
        return curves.diffraction_limit.numpy()
    known = [
        (float(field.norm()), number)
        for number, field in enumerate(curves.fields)
        if not math.isnan(float(curves.tangential_limit[number, 0]))
    ]
    return curves.tangential_limit[min(known)[1]].numpy() if known else None
