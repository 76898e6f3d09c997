"""Measurements that tell what limits a pose fit: light, rays, and errors of the start."""

import itertools
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.alignment.image_losses import SpotLoss
from dolens.alignment.information import FisherInformation, fisher_information
from dolens.alignment.measurement import Light, Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError, check_count
from dolens.experiments.poses.bench import Bench, draw, simulate
from dolens.experiments.poses.fit_plan import Stage, plain_imager, spot_imager, stage_of
from dolens.experiments.poses.fitting import iterate, loss_of, optimizer_of
from dolens.experiments.settings import check_not_negative, check_positive
from dolens.experiments.tables import Row
from dolens.rendering.spot_image import SpotImager
from dolens.sensor.pixels import Sensor
from dolens.tasks import TaskMap


@dataclass(frozen=True)
class ComparedImages:
    """Gives settings of the images that a pose is compared by.

    Attributes:
        imagers: name → settings of `SpotImager`; the first is used where rays are not the question.
        slopes: settings that differ from the first imager's for derivatives.
        centroid_weight: μ of S21, 1/mm².

    Raises:
        InputError: there is no imager.
    """

    imagers: Mapping[str, Mapping[str, Any]]
    slopes: Mapping[str, Any] = field(default_factory=dict)
    centroid_weight: float = 1.0

    def __post_init__(self) -> None:
        if not self.imagers:
            raise InputError("imagers: give at least one")
        check_not_negative("centroid_weight", self.centroid_weight)


@dataclass(frozen=True)
class PhotonLevels:
    """Describes measurements with more and more light.

    Attributes:
        levels: photons of a source.
        measurements: with other photons, of each level.

    Raises:
        InputError: fewer than 2 measurements.
    """

    levels: Sequence[float]
    measurements: int = 20

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(int(level) for level in self.levels))
        for level in self.levels:
            check_count("levels", level)
        if self.measurements < 2:
            raise InputError(f"measurements: {self.measurements}; allowed: 2 or more")


@dataclass(frozen=True)
class RayCounts:
    """Describes images by more and more rays.

    Attributes:
        counts: rays of a source.
        patterns: of rays, of each count.
        reference_photons: of the measurement that errors by rays are judged by.

    Raises:
        InputError: no pattern.
    """

    counts: Sequence[float]
    patterns: int = 4
    reference_photons: float = 200_000_000

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", tuple(int(count) for count in self.counts))
        object.__setattr__(self, "reference_photons", int(self.reference_photons))
        check_count("patterns", self.patterns)
        check_count("reference_photons", self.reference_photons)
        for count in self.counts:
            check_count("counts", count)


@dataclass(frozen=True)
class BasinSettings:
    """Describes fits by the same stages from starts whose errors in two variables make a grid.

    Attributes:
        along: two variables' names → errors of their starts, degrees or mm; the first is drawn
            across, the second upwards.
        stages: settings of `Stage`, in turn.
        centroid_weights: μ of S21, 1/mm²; a grid of fits for each.
        sensor: the pixels; None: the experiment's.
        imager: settings of `SpotImager`.
        photons: of each source.
    """

    along: Mapping[str, Sequence[float]]
    stages: Sequence[Mapping[str, Any]]
    centroid_weights: Sequence[float] = (1.0,)
    sensor: Sensor | None = None
    imager: Mapping[str, Any] = field(default_factory=dict)
    photons: float = 1_000_000

    def __post_init__(self) -> None:
        check_positive("photons", self.photons)
        for weight in self.centroid_weights:
            check_not_negative("basin.centroid_weights", weight)


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


logger = logging.getLogger(__name__)

# RMS error over bound up to which a fit has converged: S21's own errors are some bounds.
_CONVERGED = 10.0


class Basin:
    """Fits by the same stages from starts whose errors in two variables make a grid.

    Args:
        true: the lens where it is.
        bench: wavelength and sensor of the experiment.
        read_noise: RMS of a pixel, electrons.
        settings: the grid, the stages and the images.
        seed: of the measurement.

    Raises:
        InputError: a name that is not fitted, or not two of them.
    """

    def __init__(
        self,
        true: Pose,
        bench: Bench,
        read_noise: float,
        settings: BasinSettings,
        seed: int,
    ) -> None:
        along = settings.along
        unknown = set(along) - set(true.names)
        if unknown or len(along) != 2:
            raise InputError(
                f"basin.along: {', '.join(along)}; allowed: two of {', '.join(true.names)}"
            )
        self.true, self.along = true, {n: [float(e) for e in es] for n, es in along.items()}
        self.stages = [stage_of(stage) for stage in settings.stages]
        self.centroid_weights = [float(weight) for weight in settings.centroid_weights]
        self.bench = replace(bench, sensor=settings.sensor or bench.sensor)
        self.light = Light(int(settings.photons), read_noise)
        self.imager, self.seed = dict(settings.imager), seed
        plain_imager(self.bench.sensor, bench.wavelength, self.imager)
        self.rows: list[Row] = []

    def run(self, map_tasks: TaskMap) -> None:
        """Make the rows: `centroid_weight`, the start's errors, `error_over_bound` before and
        after, `converged`, `iterations`, `seconds`.

        A fit whose light is lost ends where it was, and says so in the log.

        Args:
            map_tasks: makes the fits, each of which is a task.
        """
        true, generator = self.true, torch.Generator().manual_seed(self.seed)
        measured = simulate(true, self.bench, self.light, generator)
        imager = spot_imager(measured, self.bench.wavelength, self.imager)
        bounds = fisher_information(true, imager, measured).bounds
        across, up = self.along.values()
        # The grid's rows from below, as `table` takes them.
        starts = [(first, second) for second, first in itertools.product(up, across)]
        fit = BasinFit(
            true,
            tuple(self.along),
            measured,
            bounds,
            tuple(self.stages),
            self.bench.wavelength,
            self.imager,
        )
        fits = map_tasks(
            fit.row,
            [(weight, start) for weight in self.centroid_weights for start in starts],
            "starts",
        )
        for weight in self.centroid_weights:
            for row, end in itertools.islice(fits, len(starts)):
                self.rows.append(row)
                if end:
                    logger.info("a start ends after %g iterations: %s", row["iterations"], end)
            mine = self._of(weight)
            logger.info(
                "basin, centroid weight %g: %d of %d starts converge, %.2g s each",
                weight,
                sum(row["converged"] for row in mine),
                len(mine),
                sum(row["seconds"] for row in mine) / len(mine),
            )

    def _of(self, weight: float) -> list[Row]:
        return [row for row in self.rows if row["centroid_weight"] == weight]

    def summary(self) -> dict[str, float]:
        """Return the share of starts that converge, by centroid weight."""
        numbers = {}
        for weight in self.centroid_weights:
            mine = [row["converged"] for row in self._of(weight)]
            numbers[f"basin/converged/centroid_weight_{weight:g}"] = sum(mine) / max(len(mine), 1)
        return numbers

    def table(self, weight: float) -> Tensor:
        """Return errors over bounds (second, first) of the grid with this centroid weight; NaN:
        lost.
        """
        across, up = self.along.values()
        mine = [row["error_over_bound"] for row in self._of(weight)]
        return torch.tensor(mine, dtype=torch.float64).reshape(len(up), len(across))


@dataclass(frozen=True)
class BasinFit:
    """Fits a pose from a start that is off.

    Attributes:
        true: the lens where it is.
        along: names of the two variables that are off.
        measured: what is fitted.
        bounds: (P,), of the pose.
        stages: of the fit, in turn.
        wavelength: nm.
        imager: settings of `SpotImager`.
    """

    true: Pose
    along: tuple[str, ...]
    measured: Measurement
    bounds: Tensor
    stages: tuple[Stage, ...]
    wavelength: float
    imager: Mapping[str, Any]

    def row(self, task: tuple[float, tuple[float, float]]) -> tuple[Row, str]:
        """Return a row of the basin's table, and why the fit ended early, if it did.

        Args:
            task: the centroid weight, and the start's two errors, degrees or mm.
        """
        started, true, (weight, errors) = time.perf_counter(), self.true, task
        truth = true.scale * true.scaled.detach()
        start = truth.clone()
        for name, error in zip(self.along, errors, strict=True):
            place = true.names.index(name)
            start[place] += error * true.units[place]
        pose = true.varying(true.settings)
        with torch.no_grad():
            pose.scaled.copy_(start / pose.scale)
        count, end = self._fit(pose, weight)
        left = _rms((pose.scale * pose.scaled.detach() - truth) / self.bounds)
        row = {
            "centroid_weight": weight,
            **dict(zip(self.along, errors, strict=True)),
            "initial_error_over_bound": _rms((start - truth) / self.bounds),
            "error_over_bound": left,
            "converged": float(left < _CONVERGED),
            "iterations": float(count),
            "seconds": time.perf_counter() - started,
        }
        return row, end

    def _fit(self, pose: Pose, weight: float) -> tuple[int, str]:
        """Fit, and return how many iterations were made, and what ended them early."""
        count = 0
        try:
            for stage in self.stages:
                loss = loss_of(stage, self.measured, self.wavelength, self.imager, weight)
                optimizer = optimizer_of(stage, pose)
                for _ in range(stage.iterations):
                    iterate(pose, stage, loss, optimizer)
                    count += 1
        except InputError as error:
            return count, str(error)
        return count, ""


def _rms(ratio: Tensor) -> float:
    found = float(ratio.square().mean().sqrt())
    return found if math.isfinite(found) else math.nan
