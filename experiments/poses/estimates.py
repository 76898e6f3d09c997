"""Other measurements lead to poses that are found without fitting each from its beginning."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from dolens.alignment.image_losses import ImageMerit, NoiseWeightedLoss
from dolens.alignment.information import FisherInformation
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.experiments.poses.settings import Fit
from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.rendering.spot_image import SpotImager
from dolens.tasks import TaskMap, in_turn

# One linear step is exact enough within so many bounds; longer ones are followed by others.
_NEAR = 5.0
# Iterations then, at most, their first damping, and which of them is the last: one by a part of a
# bound, or by a part of the way from the pose.
_ITERATIONS, _DAMPING, _SMALL, _PART = 12, 1e-6, 0.1, 0.02


@dataclass(frozen=True)
class Held:
    """Holds values of nuisance parameters that an earlier fit found, in θ's units (radians, mm).

    Attributes:
        names: H of them.
        units: (H,), θ's units in those of settings.
        at: (H,), in the pose that the information is on.
        found: (M, H), as the earlier fit found them in each of M measurements.
        true: (H,); NaN where no truth is known.
    """

    names: tuple[str, ...]
    units: Tensor
    at: Tensor
    found: Tensor
    true: Tensor

    def values(self, measurement: int) -> dict[str, float]:
        """Return the values of one measurement, degrees and mm."""
        found = (self.found[measurement] / self.units).tolist()
        return dict(zip(self.names, found, strict=True))


def held_numbers(fit: Fit, before: Pose, found: "Estimates", truth: Mapping[str, float]) -> Held:
    """Return the nuisance parameters that a fit takes from an earlier one.

    Args:
        fit: that holds them.
        before: the pose of the fit that found them.
        found: its estimates, of the same measurements.
        truth: by name, degrees and mm.
    """
    places = [before.names.index(name) for name in fit.held]
    units = before.units[places]
    return Held(
        fit.held,
        units,
        (before.scale * before.scaled.detach())[places],
        found.values[:, places] * units,
        torch.tensor([truth.get(n, torch.nan) for n in fit.held]).double() * units,
    )


@dataclass(frozen=True)
class Estimates:
    """Holds poses that M measurements lead to.

    Attributes:
        values: (M, P), degrees and mm.
        chi_squared: (M,), eᵀ·C⁻¹·e of the errors that these images make by themselves, C their own
            covariance: of the χ² distribution with P degrees of freedom where the model holds, and
            independent of what is held; NaN where no truth is known.
        settled: (M,), bool: the first step went a few bounds at most, or the last was a small part
            of one, or of the whole way.  The others are no estimates: iterations ended before.
    """

    values: Tensor
    chi_squared: Tensor
    settled: Tensor


@torch.no_grad()
def estimates(
    pose: Pose,
    information: FisherInformation,
    imager: SpotImager,
    measured: Callable[[int], Measurement],
    draws: Sequence[int],
    truth: Mapping[str, float],
    held: Held | None = None,
    slopes: SpotImager | None = None,
    map_tasks: TaskMap = in_turn,
) -> Estimates:
    """Find the pose of each of M measurements, from one pose that is near all of them.

    Args:
        pose: near all of the measurements'.
        information: on the pose.
        imager: makes its images.
        measured: a measurement by its number.
        draws: M numbers.
        truth: by name, degrees and mm.
        held: what the fit takes from an earlier one; None: nothing.
        slopes: makes the images' derivatives where one step does not do; None: `imager`.
        map_tasks: finds them, each a task.
    """
    true = torch.tensor([truth.get(name, torch.nan) for name in pose.names], dtype=torch.float64)
    values, chi, settled = [], [], []
    one = partial(_estimate, pose, information, imager, slopes, measured, held)
    found = map_tasks(one, list(enumerate(draws)), "measurements")
    for place, (theta, done) in enumerate(found):
        error = theta - true * pose.units
        if held is not None:
            error = error - information.nuisance_sensitivity @ (held.found[place] - held.true)
        chi.append(error @ torch.linalg.solve(information.own_covariance, error))
        values.append(theta / pose.units)
        settled.append(done)
    return Estimates(torch.stack(values), torch.stack(chi), torch.tensor(settled))


@torch.no_grad()
def _estimate(
    pose: Pose,
    information: FisherInformation,
    imager: SpotImager,
    slopes: SpotImager | None,
    measured: Callable[[int], Measurement],
    held: Held | None,
    task: tuple[int, int],
) -> tuple[Tensor, bool]:
    """Return θ (P,), and whether it has settled; a task is a place among the draws, and its draw.

    One step of weighted least squares with the derivatives of the pose is all that an error of some
    bounds needs.  Where it is longer, the measurement is fitted: by damped least squares, with
    weights and derivatives of every iteration's own, until a step is small.
    """
    place, draw = task
    measurement = measured(draw)
    at = pose.scale * pose.scaled.detach()
    moved = torch.zeros_like(at)
    if held is not None:
        moved = information.nuisance_sensitivity @ (held.found[place] - held.at)
    step = information.correction(measurement)
    if float(((moved + step).abs() / information.bounds).max()) <= _NEAR:
        return at + moved + step, True
    there = copy.deepcopy(pose)
    if held is not None:
        there.put(held.values(place))
    there.scaled.copy_((at + moved) / pose.scale)
    loss = NoiseWeightedLoss(measurement, imager, slopes, information.blur)
    optimizer = DampedLeastSquares([there.parameter_group()], initial_damping=_DAMPING)
    every = torch.ones(len(pose.names), dtype=torch.bool)
    theta = at + moved
    for _ in range(_ITERATIONS):
        before = theta
        try:
            optimizer.step(ImageMerit(loss.weighted_at(there), there, every))
        except InputError:
            # No light reaches the sensor from there.
            return before, False
        theta = pose.scale * there.scaled.detach()
        last, way = ((d / information.bounds).abs().max() for d in (theta - before, theta - at))
        if float(last) < max(_SMALL, _PART * float(way)):
            return theta, True
        # Weights are new in the next one.
        optimizer.restart()
    return theta, False


def probability(chi_squared: Tensor, freedom: int) -> Tensor:
    """Return the chance that a χ² variable of so many degrees of freedom is larger still."""
    half = torch.full_like(chi_squared, 0.5 * freedom)
    return torch.special.gammaincc(half, 0.5 * chi_squared)
