"""This package predicts what manufacturing does to a lens: sensitivities, tolerances, yield."""

from dolens.tolerancing.analysis import Outcome, ToleranceAnalysis, analyse_tolerances
from dolens.tolerancing.assembly import FocusTarget, assembled, best_focus
from dolens.tolerancing.desensitising import expected_spread
from dolens.tolerancing.linear_spots import LinearSpots, linear_spots
from dolens.tolerancing.monte_carlo import PerturbedSpots, trace_perturbed
from dolens.tolerancing.perturbations import Tolerances, scaled_tolerances, tolerances_from
from dolens.tolerancing.prediction import Contributions, contributions
from dolens.tolerancing.sensitivity import Sensitivities, sensitivities
from dolens.tolerancing.through_focus import FocusCurves, spot_weights
from dolens.tolerancing.usual import (
    fields_all_around,
    usual_tolerances,
    usual_tolerances_text,
    with_glass_elements,
)
from dolens.tolerancing.yields import Yield, quantiles, share_within

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
    "quantiles",
    "scaled_tolerances",
    "sensitivities",
    "share_within",
    "spot_weights",
    "tolerances_from",
    "trace_perturbed",
    "usual_tolerances",
    "usual_tolerances_text",
    "with_glass_elements",
]
