"""Fits from a grid of starts show from how far off a pose fit converges."""

import itertools
import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.information import fisher_information
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.experiments.poses.accuracy_settings import BasinSettings
from dolens.experiments.poses.bench import Bench, Light, simulate
from dolens.experiments.poses.iteration import iterate, loss_of, optimizer_of
from dolens.experiments.poses.settings import Stage, plain_imager, spot_imager, stage_of
from dolens.experiments.tables import Row
from dolens.tasks import TaskMap

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
