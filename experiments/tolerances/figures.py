"""Figures of a tolerance analysis."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.experiment import Figures
from dolens.experiments.tolerances.tables import per_unit
from dolens.plotting.captions import plain_text
from dolens.plotting.tolerances import (
    matrix_figure,
    offenders_figure,
    parameter_label,
    tolerance_label,
    yield_figure,
)
from dolens.tolerancing import ToleranceAnalysis

_MOST_OFFENDERS = 20
_UNIT_WORDS = {"deg": "µm/°", "mm": "µm/mm", "%": "µm/%", "1/mm": "µm·mm"}


def tolerance_figures(
    found: ToleranceAnalysis, title: str, spots: Sequence[str], weights: Tensor
) -> Figures:
    """Return Jacobians as matrices, yield curves, and the worst offenders.

    Args:
        found: the analysis.
        title: the lens and its aperture; what a figure shows is written below it.
        spots: labels of its S spots.
        weights: (S,), weights of the spots, of sum 1.
    """
    s, t, c = found.sensitivities, found.tolerances, found.contributions
    spots = list(spots)
    blocks = [("x", len(spots)), ("y", len(spots))]
    motion = s.centroid_jacobian.transpose(0, 1).flatten(0, 1)
    labels = [plain_text(parameter_label(parameter)) for parameter in t.names]
    with_tolerance = [tolerance_label(n, t.label(p)) for p, n in enumerate(t.names)]
    scale = 1e3 * per_unit(t)
    first = c.order[:_MOST_OFFENDERS]
    ends = s.rms_at_ends_refocused.square() - s.rms_refocused.square()
    return {
        "centroid_jacobian": lambda: matrix_figure(
            _by_unit(motion * scale, labels, t.unit_names),
            spots * 2,
            blocks,
            f"{title}\nhow spots move: Jacobian of their centroids, rays over the whole stop",
        ),
        "centroid_by_tolerance": lambda: matrix_figure(
            {"motion (µm)": (1e3 * motion * s.steps, with_tolerance)},
            spots * 2,
            blocks,
            f"{title}\nhow far a whole tolerance moves spots, rays over the whole stop",
        ),
        "rms_jacobian": lambda: matrix_figure(
            _by_unit(s.rms_jacobian * scale, labels, t.unit_names),
            spots,
            title=f"{title}\nJacobian of the spots' RMS radii, rays over the whole stop",
        ),
        "rms_by_tolerance": lambda: matrix_figure(
            {
                "growth of RMS to first order, not refocused (µm)": (
                    1e3 * s.rms_jacobian * s.steps,
                    with_tolerance,
                ),
                "RMS² at the worse end less that as designed, refocused (µm²)": (
                    1e6 * ends.amax(0).T,
                    with_tolerance,
                ),
            },
            spots,
            title=f"{title}\nwhat a whole tolerance does to the spots' RMS radii",
        ),
        "yield": lambda: _yields(found, title, weights),
        "worst_offenders": lambda: offenders_figure(
            [with_tolerance[p] for p in first],
            c.share[first].tolist(),
            {
                "refocused": s.increase()[first].tolist(),
                "not refocused": s.increase(refocused=False)[first].tolist(),
            },
            f"{title}\nworst offenders",
        ),
    }


def _yields(found: ToleranceAnalysis, title: str, weights: Tensor) -> Figure:
    outcomes = {
        f"{how}, {stage}": outcome.found(stage == "refocused")
        for stage in ("refocused", "not refocused")
        for how, outcome in (("Monte Carlo", found.traced), ("linear", found.linear))
    }
    design = found.sensitivities.rms_refocused.square()
    mean, worst = "RMS radius over all spots", "RMS radius of the worst spot"
    return yield_figure(
        {
            mean: {label: radii.rms for label, radii in outcomes.items()},
            worst: {label: radii.worst for label, radii in outcomes.items()},
        },
        {
            mean: float((design @ weights).sqrt()),
            worst: float(design[weights > 0.0].amax().sqrt()),
        },
        f"{title}\n{len(found.errors)} lenses drawn from the tolerances",
    )


def _by_unit(
    matrix: Tensor, labels: list[str], units: tuple[str, ...]
) -> dict[str, tuple[Tensor, list[str]]]:
    """Return a panel for each unit, since numbers of several units share no scale."""
    panels = {}
    for unit in dict.fromkeys(units):
        columns = [p for p, other in enumerate(units) if other == unit]
        panels[_UNIT_WORDS.get(unit, "µm per unit")] = (
            matrix[:, torch.tensor(columns)],
            [labels[p] for p in columns],
        )
    return panels
