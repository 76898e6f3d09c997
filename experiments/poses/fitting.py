"""Poses are fitted: by iterations of a stage's optimizer, or to measurements that are near."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.image_losses import ImageLoss, ImageMerit, NoiseWeightedLoss, SpotLoss
from dolens.alignment.information import FisherInformation
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.experiments.poses.fit_plan import (
    Fit,
    Stage,
    blur_for,
    slopes_imager,
    spot_imager,
    values_imager,
)
from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.rendering.spot_image import SpotImager
from dolens.tasks import TaskMap, in_turn


def loss_of(
    stage: Stage,
    measurement: Measurement,
    wavelength: float,
    imager: Mapping[str, Any],
    centroid_weight: float,
) -> ImageLoss:
    """Return the loss that a stage minimises.

    Args:
        stage: says which loss, and what differs from the other arguments.
        measurement: what is to be explained.
        wavelength: nm.
        imager: settings of the experiment's, see `spot_imager`.
        centroid_weight: of the experiment, μ of S21, 1/mm².
    """
    if stage.loss == "noise_weighted":
        own = values_imager(measurement, wavelength, imager, stage.imager)
        slopes, blur = slopes_of(stage, measurement, wavelength, imager)
        return NoiseWeightedLoss(measurement, own, slopes, blur, stage.noise_blur)
    own = spot_imager(measurement, wavelength, imager, stage.imager)
    weight = centroid_weight if stage.centroid_weight is None else stage.centroid_weight
    # From afar an image near focus is found by wide patches, those of the widest image.
    return SpotLoss(measurement, replace(own, subpixels_of=None), weight, stage.blur or 0.0)


def slopes_of(
    stage: Stage, measurement: Measurement, wavelength: float, imager: Mapping[str, Any]
) -> tuple[SpotImager, float]:
    """Return the imager of a stage's derivatives when images are weighted by noise, and their blur
    (px).
    """
    slopes = slopes_imager(measurement, wavelength, imager, stage.imager, stage.slopes)
    return slopes, blur_for(measurement, slopes) if stage.blur is None else stage.blur


def optimizer_of(stage: Stage, pose: Pose) -> torch.optim.Optimizer:
    """Return the optimizer of a stage's iterations."""
    if stage.optimizer == "adam":
        return torch.optim.Adam([pose.scaled], lr=stage.learning_rate)
    return DampedLeastSquares([pose.parameter_group()], initial_damping=stage.damping)


def iterate(
    pose: Pose,
    stage: Stage,
    loss: ImageLoss,
    optimizer: torch.optim.Optimizer,
    step: Callable[..., Any] | None = None,
) -> dict[str, Tensor]:
    """Move the pose's variables by one iteration.

    Args:
        pose: whose `scaled` the optimizer moves.
        stage: says which of its variables may.
        loss: of the stage; its weights are those of the pose where the iteration begins.
        optimizer: of the stage, bare of Lightning's wrapping.
        step: what is called in the place of its own.

    Returns:
        Terms of the loss by name: before an iteration of Adam, after one of least squares.
    """
    step = step or optimizer.step
    chosen = torch.tensor(
        [stage.variables is None or name in stage.variables for name in pose.names]
    )
    weighted = loss.weighted_at(pose)
    if isinstance(optimizer, DampedLeastSquares):
        merit = ImageMerit(weighted, pose, chosen)
        if weighted is not loss:
            # Its weights are new, so what had nothing to gain may have.
            optimizer.restart()
        step(merit)
        return loss.terms(merit().residuals)
    optimizer.zero_grad()
    residuals = weighted.residuals(pose)
    residuals.square().sum().backward()
    pose.scaled.grad.mul_(chosen)
    step()
    pose.project()
    return loss.terms(residuals.detach())


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
