"""A tolerance analysis joins sensitivities, a Monte Carlo, a linear prediction and the yield."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.tasks import TaskMap
from dolens.tolerancing.monte_carlo import PerturbedSpots, trace_perturbed
from dolens.tolerancing.sensitivity import (
    Contributions,
    FocusCurves,
    Sensitivities,
    contributions,
    linear_spots,
    sensitivities,
)
from dolens.tolerancing.tolerances import Tolerances


@dataclass(frozen=True)
class Yield:
    """Holds the spot sizes of K lenses.

    Attributes:
        rms: (K,), mm, ascending: √(Σ W·RMS²) over the spots; infinite for a lens that fails.
        worst: (K,), mm, ascending on its own: RMS radius of each lens's worst spot.
    """

    rms: Tensor
    worst: Tensor

    @staticmethod
    def of(mean_squares: Tensor, weights: Tensor) -> "Yield":
        """Return the yield of RMS² of every spot, (K, S), mm², with the spots' weights (S,), which
        sum to one.

        Spots of weight zero count neither in the one nor in the other.
        """
        counted = weights > 0.0
        squares = mean_squares[:, counted]
        overall = (squares * weights[counted]).sum(-1).sqrt()
        return Yield(overall.sort().values, squares.amax(-1).sqrt().sort().values)


def share_within(ascending: Tensor, limit: float) -> float:
    """Return the share of lenses whose RMS (K, sorted) is at most a limit, in the same unit."""
    found = torch.searchsorted(ascending, torch.tensor(limit).to(ascending), right=True)
    return int(found) / len(ascending)


def quantiles(ascending: Tensor, shares: Sequence[float]) -> list[float]:
    """Return, for each share of the lenses, the least RMS (K, sorted) that so many of them stay
    within.

    Raises:
        InputError: a share outside 0 to 1.
    """
    for share in shares:
        if not 0.0 < share <= 1.0:
            raise InputError(f"quantiles lie above 0 and up to 1, not at {share}")
    count = len(ascending)
    # Less than a rounding, or 0.9·10 would count as more than nine.
    return [float(ascending[math.ceil(share * count - 1e-9) - 1]) for share in shares]


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
