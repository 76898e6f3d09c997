"""Tasks of `PoseAccuracyModule`: measurements and images, and the errors of a pose by each."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.alignment.image_losses import SpotLoss
from dolens.alignment.information import FisherInformation, fisher_information
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.experiments.poses.bench import Bench, Light, draw, simulate
from dolens.rendering.spot_image import SpotImager

ESTIMATORS = ("noise_weighted", "s21")


@dataclass(frozen=True)
class AccuracyModel:
    """Describes the lens where it is, and how it is measured and modelled.

    Attributes:
        true: the lens where it is.
        bench: sources, wavelength and sensor.
        light: noise of measurements.
        imager: makes the model's images.
        slopes: makes their derivatives.
        centroid_weight: μ of S21, 1/mm².
        seed: of the run's measurements.
    """

    true: Pose
    bench: Bench
    light: Light
    imager: SpotImager
    slopes: SpotImager
    centroid_weight: float
    seed: int

    def measurement(self, photons: int, number: int) -> Measurement:
        """Return a measurement with so many photons of each source, by its number."""
        light = replace(self.light, photons=photons)
        return simulate(self.true, self.bench, light, draw(self.seed, 0, number))

    def s21_inverse(self, measurement: Measurement) -> Tensor:
        """Return the pseudo-inverse (P, rows) of S21's Jacobian with respect to u, at the truth.

        Another measurement's largest pixel scales all rows but those of the centroids a little
        otherwise, which moves the least squares by as little.
        """
        loss = SpotLoss(measurement, self.slopes, self.centroid_weight)
        every = torch.ones(len(self.true.names), dtype=torch.bool)
        return torch.linalg.pinv(loss.jacobian(self.true, every)[1])

    def s21_step(self, measurement: Measurement, imager: SpotImager, inverse: Tensor) -> Tensor:
        """Return the step (P,) of S21 from the truth, in the units of θ."""
        loss = SpotLoss(measurement, imager, self.centroid_weight)
        return -self.true.scale * (inverse @ loss.residuals(self.true))


class AtTruth(NamedTuple):
    """Holds both estimators' derivatives at the truth.

    Attributes:
        information: on the pose.
        s21_inverse: (P, rows).
    """

    information: FisherInformation
    s21_inverse: Tensor


@torch.no_grad()
def linearised(model: AccuracyModel, task: tuple[int, int]) -> AtTruth:
    """Return the derivatives that a measurement has at the truth.

    Args:
        model: of the experiment.
        task: photons, and the number of the measurement.
    """
    measured = model.measurement(*task)
    information = fisher_information(model.true, model.imager, measured, model.slopes)
    return AtTruth(information, model.s21_inverse(measured))


@torch.no_grad()
def errors_by_photons(
    model: AccuracyModel, levels: Sequence[int], prepared: Sequence[AtTruth], task: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return the errors (P,) of both estimators from one measurement.

    Args:
        model: of the experiment.
        levels: photons.
        prepared: derivatives of each level.
        task: numbers of the level and of the measurement.
    """
    level, number = task
    measured, (information, inverse) = model.measurement(levels[level], number), prepared[level]
    return information.correction(measured), model.s21_step(measured, model.imager, inverse)


@torch.no_grad()
def errors_by_rays(
    model: AccuracyModel,
    at_truth: AtTruth,
    quoted: Measurement,
    reference: Measurement,
    imager: SpotImager,
) -> tuple[Tensor, Tensor, float]:
    """Return the errors (P,) of both estimators from one model of the images, and its seconds.

    Args:
        model: of the experiment.
        at_truth: derivatives.
        quoted: the measurement, with the light that errors are compared with.
        reference: the same, with all its light.
        imager: of the model.
    """
    started = time.perf_counter()
    shares = torch.stack([image.image for image in model.true.images(imager)])
    seconds = time.perf_counter() - started
    modelled = replace(at_truth.information, expected=shares)
    step = model.s21_step(reference, imager, at_truth.s21_inverse)
    return modelled.correction(quoted), step, seconds
