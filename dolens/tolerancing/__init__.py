"""This package predicts what manufacturing does to a lens: sensitivities, tolerances, yield."""

from dolens.tolerancing.assembly import FocusTarget, assembled, best_focus, expected_spread
from dolens.tolerancing.monte_carlo import (
    Outcome,
    PerturbedSpots,
    ToleranceAnalysis,
    Yield,
    analyse_tolerances,
    quantiles,
    share_within,
    trace_perturbed,
)
from dolens.tolerancing.sensitivity import (
    Contributions,
    FocusCurves,
    LinearSpots,
    Sensitivities,
    contributions,
    linear_spots,
    linear_spots_over_field,
    sensitivities,
    spot_weights,
    spots_over_field,
)
from dolens.tolerancing.tolerances import (
    Tolerances,
    fields_all_around,
    scaled_tolerances,
    tolerances_from,
    usual_tolerances,
    usual_tolerances_text,
    with_glass_elements,
)

__all__ = [
    "Contributions",
    "FocusCurves",
    "FocusTarget",
    "LinearSpots",
    "Outcome",
    "PerturbedSpots",
    "Sensitivities",
    "ToleranceAnalysis",
    "Tolerances",
    "Yield",
    "analyse_tolerances",
    "assembled",
    "best_focus",
    "contributions",
    "expected_spread",
    "fields_all_around",
    "linear_spots",
    "linear_spots_over_field",
    "quantiles",
    "scaled_tolerances",
    "sensitivities",
    "share_within",
    "spot_weights",
    "spots_over_field",
    "tolerances_from",
    "trace_perturbed",
    "usual_tolerances",
    "usual_tolerances_text",
    "with_glass_elements",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
