"""An iteration of a pose fit moves its variables by the optimizer of the stage."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.image_losses import ImageLoss, ImageMerit, NoiseWeightedLoss, SpotLoss
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.experiments.poses.settings import (
    Stage,
    blur_for,
    slopes_imager,
    spot_imager,
    values_imager,
)
from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.rendering.spot_image import SpotImager


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
