"""Errors of a pose fit by photons and rays, and its basin of convergence."""

import copy
import itertools
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.information import fisher_information
from dolens.alignment.measurement import Light
from dolens.errors import InputError, check_choice, check_keys
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.poses.accuracy_figures import basin_figure, photons_figure, rays_figure
from dolens.experiments.poses.accuracy_tasks import (
    ESTIMATORS,
    AccuracyModel,
    AtTruth,
    Basin,
    BasinSettings,
    ComparedImages,
    PhotonLevels,
    RayCounts,
    errors_by_photons,
    errors_by_rays,
    linearised,
)
from dolens.experiments.poses.bench import Bench, check_precision
from dolens.experiments.tables import Row
from dolens.experiments.workers import workers_of
from dolens.optics.lens import Lens
from dolens.plotting.layout import lens_title
from dolens.rendering.spot_image import SpotImager
from dolens.tasks import TaskMap
from dolens.tasks import stage as named_stage
from dolens.typed_values import call_with_settings, check_types

logger = logging.getLogger(__name__)

PARTS = ("photons", "rays", "basin")


class PoseAccuracyModule(Analysis):
    """Measures how light, rays and the start limit a pose fit.

    Errors by light and by rays are those of one Gauss-Newton step from the truth, which is where an
    estimate from there ends but for terms of second order in its error.

    Args:
        lens: as designed; its elements may have poses.
        bench: sources, wavelength and sensor.
        light: light and noise; its photons are those that errors by rays are compared with.
        truth: where the lens and the sources are, by name, degrees and mm.
        variables: name → settings of `Pose`: what is fitted; it starts from the truth, or off it.
        images: settings of the model's images.
        by_photons: measurements with more and more light.
        by_rays: images by more and more rays.
        basin: fits from farther and farther starts.
        parts: of `photons`, `rays` and `basin`.
        seed: of simulations.
        workers: where measurements are simulated and fits are made; see `workers_of`.

    Raises:
        InputError: a setting that is unknown or out of range.
    """

    metrics = (
        "pose_error/reference_over_bound",
        "pose_error/over_bound/*",
        "basin/converged/*",
    )

    def __init__(
        self,
        lens: Lens,
        bench: Bench,
        light: Light,
        truth: Mapping[str, float],
        variables: Mapping[str, Mapping[str, Any] | None],
        images: ComparedImages,
        by_photons: PhotonLevels,
        by_rays: RayCounts,
        basin: BasinSettings,
        parts: Sequence[str] = PARTS,
        seed: int = 0,
        workers: int | str | None = None,
    ) -> None:
        super().__init__(lens)
        self.workers = workers_of(workers)
        for part in parts:
            check_choice(part, PARTS, "parts")
        check_precision(lens, "fitted")
        if not variables:
            raise InputError("variables: give at least one")
        self.seed, self.parts = int(seed), tuple(parts)
        self.bench, self.light, self.images = bench, light, images
        self.by_photons, self.by_rays = by_photons, by_rays
        self.imagers = {
            name: call_with_settings(
                SpotImager, settings, f"imagers.{name}", bench.sensor, bench.wavelength
            )
            for name, settings in images.imagers.items()
        }
        self.imager = next(iter(self.imagers.values()))
        check_keys(images.slopes, SpotImager.__dataclass_fields__, "slopes")
        check_types(SpotImager, images.slopes, "slopes")
        self.slopes = replace(self.imager, **images.slopes)
        place = bench.pose(copy.deepcopy(lens))
        place.put(truth)
        # It starts from where the lens now is, whatever initial values are given.
        free = {name: {**(s or {})} for name, s in variables.items()}
        for settings in free.values():
            settings.pop("initial", None)
        self.true = place.varying(free)
        self.basin = Basin(self.true, bench, light.read_noise, basin, self.seed)
        self.rows: list[Row] = []
        self.numbers: dict[str, float] = {}

    def analyse(self) -> dict[str, float]:
        """Measure part by part, and write the tables after each, whole or not."""
        with self.workers.open() as map_tasks:
            for part in self.parts:
                started = time.perf_counter()
                logger.info("%s", part)
                try:
                    with named_stage(part):
                        getattr(self, f"_{part}")(map_tasks)
                finally:
                    self.write_tables()
                self.numbers[f"cost/{part}_s"] = time.perf_counter() - started
        return self.numbers

    def tables(self) -> dict[str, list[Row]]:
        """Return `accuracy` and `basin`, as far as they have been measured."""
        return {"accuracy": self.rows, "basin": self.basin.rows}

    def figures(self) -> Figures:
        """Return a figure for each part that was measured, by its name."""
        name = lens_title(self.lens)
        title = f"{name}\nerror and light, {self.by_photons.measurements} measurements each"
        figures = {
            "photons": lambda: photons_figure(
                self.rows, self.true, title, self.by_photons.measurements
            ),
            "rays": lambda: rays_figure(
                self.numbers,
                self.imagers,
                self.by_rays.counts,
                int(self.light.photons),
                name,
            ),
            "basin": lambda: basin_figure(self.basin, name),
        }
        return {part: figures[part] for part in self.parts}

    # ---------------------------------------------------------------- light

    def _photons(self, map_tasks: TaskMap) -> None:
        """Find errors of estimates from measurements of more and more light."""
        levels, count = self.by_photons.levels, self.by_photons.measurements
        model = self._model()
        first = partial(linearised, model)
        prepared = list(
            map_tasks(first, [(level, 1000 * n) for n, level in enumerate(levels)], "levels")
        )
        tasks = [(n, 1000 * n + draw) for n in range(len(levels)) for draw in range(count)]
        corrected = map_tasks(
            partial(errors_by_photons, model, levels, prepared), tasks, "measurements"
        )
        for level, at_truth in zip(levels, prepared, strict=True):
            own = list(itertools.islice(corrected, count))
            for estimator, found in zip(ESTIMATORS, zip(*own, strict=True), strict=True):
                rms = torch.stack(found).square().mean(0).sqrt()
                self._add("photons", estimator, level, rms, at_truth.information.bounds)
            logger.info("%.3g photons: %s", level, self._last_ratios())

    # ---------------------------------------------------------------- rays

    @torch.no_grad()
    def _rays(self, map_tasks: TaskMap) -> None:
        """Find the errors that few rays make."""
        reference_photons, photons = self.by_rays.reference_photons, int(self.light.photons)
        model = self._model()
        reference = model.measurement(reference_photons, 999_999)
        exact = fisher_information(self.true, self.imager, reference, self.slopes)
        # Bounds and weights are those of the light that is quoted.
        share = photons / reference_photons
        quoted = replace(
            reference,
            images=share * reference.images,
            read_noise=self.light.read_noise,
        )
        information = fisher_information(self.true, self.imager, quoted, self.slopes)
        inverse = model.s21_inverse(reference)
        floor = float((exact.bounds / information.bounds).square().mean().sqrt())
        self.numbers["pose_error/reference_over_bound"] = floor
        kinds = [(name, count) for name in self.imagers for count in self.by_rays.counts]
        patterns = self.by_rays.patterns
        tasks = [
            replace(self.imagers[name], rays=count, seed=pattern + 1)
            for name, count in kinds
            for pattern in range(patterns)
        ]
        at_truth = AtTruth(information, inverse)
        stepped = map_tasks(
            partial(errors_by_rays, model, at_truth, quoted, reference), tasks, "patterns of rays"
        )
        for name, count in kinds:
            *found, seconds = zip(*itertools.islice(stepped, patterns), strict=True)
            for estimator, steps in zip(ESTIMATORS, found, strict=True):
                rms = torch.stack(steps).square().mean(0).sqrt()
                self._add(f"rays/{name}", estimator, count, rms, information.bounds, min(seconds))
            logger.info("%s, %.3g rays: %s", name, count, self._last_ratios())

    # ---------------------------------------------------------------- where it starts

    def _basin(self, map_tasks: TaskMap) -> None:
        """Fit from starts that are farther and farther off."""
        self.basin.run(map_tasks)
        self.numbers |= self.basin.summary()

    # ---------------------------------------------------------------- estimates and rows

    def _model(self) -> AccuracyModel:
        """Return what tasks know of this experiment."""
        return AccuracyModel(
            self.true,
            self.bench,
            self.light,
            self.imager,
            self.slopes,
            self.images.centroid_weight,
            self.seed,
        )

    def _add(
        self,
        part: str,
        estimator: str,
        count: int,
        rms: Tensor,
        bounds: Tensor,
        seconds: float = math.nan,
    ) -> None:
        """Add rows of accuracy.csv, one for each variable, in degrees and mm."""
        units = self.true.units
        for place, name in enumerate(self.true.names):
            self.rows.append(
                {
                    "part": part,
                    "estimator": estimator,
                    "count": float(count),
                    "variable": name,
                    "rms_error": float(rms[place] / units[place]),
                    "bound": float(bounds[place] / units[place]),
                    "image_s": seconds,
                }
            )
        key = f"pose_error/over_bound/{part}_{count:g}/{estimator}"
        self.numbers[key] = float((rms / bounds).square().mean().sqrt())

    def _last_ratios(self) -> str:
        """Return the RMS errors over bounds that were added last, for the log."""
        last = list(self.numbers.items())[-len(ESTIMATORS) :]
        return ", ".join(f"{name.rpartition('/')[2]} {value:.3g} bounds" for name, value in last)
