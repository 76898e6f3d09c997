"""A tolerance analysis joins sensitivities, a Monte Carlo and a linear prediction of one lens."""

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.lens import Lens
from dolens.tasks import TaskMap
from dolens.tolerancing.linear_spots import linear_spots
from dolens.tolerancing.monte_carlo import PerturbedSpots, trace_perturbed
from dolens.tolerancing.perturbations import Tolerances
from dolens.tolerancing.prediction import Contributions, contributions
from dolens.tolerancing.sensitivity import Sensitivities, sensitivities
from dolens.tolerancing.through_focus import FocusCurves
from dolens.tolerancing.yields import Yield


@dataclass(frozen=True)
class Outcome:
    """Holds the spots of K lenses with the sensor where it stands, and at each lens's best focus.

    They are the S spots that count, those whose weight is not zero.

    Attributes:
        curves: (K, S).
        refocus: (K,), mm, how far the compensator moved the sensor.
        before: (K, S), mm², RMS² of every spot.
        after: (K, S), mm², refocused.
        weights: (S,), of the spots; they sum to one.
    """

    curves: FocusCurves
    refocus: Tensor
    before: Tensor
    after: Tensor
    weights: Tensor

    @staticmethod
    def of(curves: FocusCurves, weights: Tensor) -> "Outcome":
        """Return the outcome of spots through focus, with the compensator worked out."""
        refocus = curves.best_focus(weights)
        return Outcome(curves, refocus, curves.at(), curves.at(refocus), weights)

    def found(self, refocused: bool = True) -> Yield:
        """Return the lenses' RMS in ascending order."""
        return Yield.of(self.after if refocused else self.before, self.weights)


@dataclass(frozen=True)
class ToleranceAnalysis:
    """Holds everything that is known about the tolerances of a lens.

    Spots of weight zero have sensitivities, and are left out of the lenses that are drawn.

    Attributes:
        spots: rays of the lens as designed.
        tolerances: P of them.
        sensitivities: of every tolerance alone.
        contributions: of every tolerance to the mean square radius, refocused.
        errors: (K, P), of the lenses that were drawn, in the lens's units.
        traced: Monte Carlo.
        linear: the linear ray model's prediction for the same lenses.
        perturbed: what the Monte Carlo found besides.
        seconds: that the Monte Carlo took.
    """

    spots: SpotRays
    tolerances: Tolerances
    sensitivities: Sensitivities
    contributions: Contributions
    errors: Tensor
    traced: Outcome
    linear: Outcome
    perturbed: PerturbedSpots
    seconds: float


def analyse_tolerances(
    lens: Lens,
    spots: SpotRays,
    tolerances: Tolerances,
    weights: Tensor,
    lenses: int,
    generator: torch.Generator,
    chunk_size: int | None = None,
    map_tasks: TaskMap | None = None,
) -> ToleranceAnalysis:
    """Work everything out for one set of tolerances.

    Args:
        lens: as designed, in double precision.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        tolerances: of the lens.
        weights: (S,), of the spots; they sum to one.
        lenses: K, how many to draw.
        generator: of the errors.
        chunk_size: see `trace_perturbed`.
        map_tasks: see `trace_perturbed`.
    """
    model = linear_spots(lens, spots, tolerances.names)
    errors = tolerances.draw(lenses, generator)
    counts = weights > 0.0
    started = time.perf_counter()
    perturbed = trace_perturbed(
        lens, spots.some(counts), tolerances.names, errors, chunk_size, map_tasks
    )
    seconds = time.perf_counter() - started
    return ToleranceAnalysis(
        spots,
        tolerances,
        sensitivities(model, tolerances.steps, weights),
        contributions(model, tolerances, weights),
        errors,
        Outcome.of(perturbed.curves, weights[counts]),
        Outcome.of(model.some(counts).focus_curves(errors), weights[counts]),
        perturbed,
        seconds,
    )
