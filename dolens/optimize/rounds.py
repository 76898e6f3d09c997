"""A design without a training loop: rounds of damped least squares, as an experiment makes them.

A round begins by choosing the rays that pass the lens as it then is, and ends when nothing more is
to be gained.  The lens of the best round is kept.
"""

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.optimize.image_quality import ImageQuality
from dolens.optimize.merit import MeritValue, OperandValue
from dolens.optimize.merit_settings import MeritSettings
from dolens.optimize.states import StatesValue, write_foci
from dolens.optimize.variables import DesignVariables

# As conf/optimizer/damped_least_squares.yaml and conf/module/design.yaml have them.
_MERIT_TOLERANCE = 1e-9
_ROUND_TOLERANCE = 1e-3


@dataclass(frozen=True)
class DesignPoint:
    """Holds a lens of a design, and its numbers over the rays that pass it.

    Attributes:
        lens: a copy, in double precision.
        merit: the sum of squares.
        quality: the rays' part of it; None without rays.
        operands: their values.
        variables: label → value, in the unit of files.
    """

    lens: Lens
    merit: float
    quality: float | None
    operands: tuple[OperandValue, ...]
    variables: dict[str, float]


@dataclass(frozen=True)
class Design:
    """Holds what rounds of least squares made of a lens.

    Attributes:
        before: where the search began.
        after: the best round's end, or where it began.
        history: the merit before the first iteration and after each, over its round's rays.
        bounds: label of every variable → its lower and upper bound, in the unit of files.
        at_bounds: labels of those that stand at one.
        stopped: why the search ended, in words.
        rays: of one evaluation.
        seconds: that the search took.
    """

    before: DesignPoint
    after: DesignPoint
    history: tuple[float, ...]
    bounds: dict[str, tuple[float, float]]
    at_bounds: tuple[str, ...]
    stopped: str
    rays: int
    seconds: float


def design(
    lens: Lens,
    variables: Mapping[str, Mapping[str, Any] | None],
    settings: MeritSettings,
    iterations: int,
) -> Design:
    """Search for the lens of the least merit by damped least squares.

    Args:
        lens: where the search begins; not changed.
        variables: settings of `DesignVariables`.
        settings: of the merit function.
        iterations: at most, over all rounds.

    Raises:
        InputError: there are no variables, a setting is refused, or the lens where the search
            begins has no merit: rays fail, or apertures clip too much.
    """
    started = time.perf_counter()
    found = lens.storing_its_values().double()
    chosen = DesignVariables(found, variables)
    if not len(chosen):
        raise InputError("variables: there are none; name a parameter, as surfaces.*.curvature")
    chosen.project()
    chosen.write_to(found)
    merit = settings.build(found, chosen)
    value = merit()
    light = {state: quality.spots.light for state, quality in merit.qualities.items()}
    before = best = _point(found, chosen, value)
    if not math.isfinite(before.merit):
        raise InputError(
            "the search cannot begin: rays fail, or apertures clip more than max_vignetting of a "
            "spot"
        )
    optimizer = DampedLeastSquares([chosen.parameter_group()], merit_tolerance=_MERIT_TOLERANCE)
    history, reason = [before.merit], ""
    place = chosen.scaled.detach().clone()
    while not reason:
        while not optimizer.stopped and len(history) <= iterations:
            history.append(float(optimizer.step(merit)))
        merit().write_to(found)
        last = best.merit
        try:
            merit = settings.build(found, chosen)
            for state, quality in merit.qualities.items():
                refuse_lost_light(quality, light[state])
            reached = _point(found, chosen, merit())
        except InputError as problem:
            reason = f"the last lens fails, and the best before it is kept: {problem}"
            break
        if reached.merit < best.merit:
            best, place = reached, chosen.scaled.detach().clone()
        if not last - reached.merit > _ROUND_TOLERANCE * last:
            reason = optimizer.stopped or "a round gained less than 0.1 % of the merit"
        elif len(history) > iterations:
            reason = "all iterations are made"
        else:
            optimizer.restart()
    scale, labels = chosen.file_scale, chosen.labels()
    at_bound = (place <= chosen.lower) | (place >= chosen.upper)
    limits = zip((scale * chosen.lower).tolist(), (scale * chosen.upper).tolist(), strict=True)
    return Design(
        before,
        best,
        tuple(history),
        dict(zip(labels, limits, strict=True)),
        tuple(label for label, at in zip(labels, at_bound.tolist(), strict=True) if at),
        reason,
        sum(len(quality.spots.weight) for quality in merit.qualities.values()),
        time.perf_counter() - started,
    )


def _point(lens: Lens, variables: DesignVariables, value: MeritValue | StatesValue) -> DesignPoint:
    """Return a point of a search, with a lens of its own."""
    there = copy.deepcopy(lens)
    variables.write_to(there)
    write_foci(there, value.foci())
    qualities = [found.merit for found in value.qualities.values()]
    return DesignPoint(
        there,
        value.sum_of_squares(),
        math.fsum(qualities) if qualities else None,
        tuple(value.operands or ()),
        variables.file_values(),
    )


def spot_labels(spots: SpotRays) -> list[str]:
    """Return the label of every spot, as `x,y/588nm`."""
    fields, waves = spots.fields.tolist(), spots.wavelengths.tolist()
    return [f"{x:g},{y:g}/{w:.0f}nm" for (x, y), w in zip(fields, waves, strict=True)]


def refuse_lost_light(quality: ImageQuality, initial_light: Tensor) -> None:
    """Check that no spot has lost too much light since a search began.

    Each round takes its rays from the lens as it then is, so that every one could lose some.

    Args:
        quality: that of the present round.
        initial_light: (S,), the light of its spots when the search began; see `SpotRays.light`.

    Raises:
        InputError: a spot has lost more than `max_vignetting` of its light.
    """
    least = initial_light * (1.0 - quality.max_vignetting)
    lost = quality.spots.light < least.to(quality.spots.light)
    if bool(lost.any()):
        label = spot_labels(quality.spots)[int(torch.nonzero(lost)[0])]
        raise InputError(
            f"spot {label} has lost more than merit.max_vignetting = "
            f"{quality.max_vignetting:g} of the light that it had at first"
        )
