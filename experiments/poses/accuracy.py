"""Errors of a pose fit by photons and rays, and its basin of convergence."""

import copy
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.information import fisher_information
from dolens.alignment.measurement import Measurement
from dolens.alignment.spot_loss import SpotLoss
from dolens.errors import InputError, call_with_settings, check_choice, check_keys
from dolens.experiments.analysis import Analysis
from dolens.experiments.experiment import Figures
from dolens.experiments.poses.accuracy_figures import basin_figure, photons_figure, rays_figure
from dolens.experiments.poses.accuracy_settings import (
    BasinSettings,
    ComparedImages,
    PhotonLevels,
    RayCounts,
)
from dolens.experiments.poses.basin import Basin
from dolens.experiments.poses.bench import Bench, Light, check_precision, draw, simulate
from dolens.experiments.tables import Row
from dolens.optics.lens import Lens
from dolens.plotting.layout import lens_title
from dolens.rendering.spot_image import SpotImager
from dolens.stages import stage as named_stage

logger = logging.getLogger(__name__)

PARTS = ("photons", "rays", "basin")
ESTIMATORS = ("noise_weighted", "s21")


class PoseAccuracyModule(Analysis):
    """Measures how light, rays and the start limit a pose fit.

    Errors by light and by rays are those of one Gauss-Newton step from the truth, which is where an
    estimate from there ends but for terms of second order in its error.

    Args:
        lens: as designed; its elements may have poses.
        experiment: name of the experiment.
        folder: where tables go.
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

    Raises:
        InputError: a setting that is unknown or out of range.
    """

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        folder: str,
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
    ) -> None:
        super().__init__(lens, experiment, folder)
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
        """Measure part by part, and write the tables after each."""
        for part in self.parts:
            started = time.perf_counter()
            logger.info("%s", part)
            with named_stage(part):
                getattr(self, f"_{part}")()
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

    @torch.no_grad()
    def _photons(self) -> None:
        """Find errors of estimates from measurements of more and more light."""
        for number, level in enumerate(self.by_photons.levels):
            seeds = range(1000 * number, 1000 * number + self.by_photons.measurements)
            measured = [self._measurement(level, seed) for seed in seeds]
            information = fisher_information(self.true, self.imager, measured[0], self.slopes)
            inverse = self._s21_inverse(measured[0])
            errors = {
                "noise_weighted": torch.stack([information.correction(m) for m in measured]),
                "s21": torch.stack([self._s21_step(m, self.imager, inverse) for m in measured]),
            }
            for estimator, found in errors.items():
                rms = found.square().mean(0).sqrt()
                self._add("photons", estimator, level, rms, information.bounds)
            logger.info("%.3g photons: %s", level, self._last_ratios())

    def _measurement(self, photons: int, seed: int) -> Measurement:
        light = replace(self.light, photons=photons)
        return simulate(self.true, self.bench, light, draw(self.seed, 0, seed))

    # ---------------------------------------------------------------- rays

    @torch.no_grad()
    def _rays(self) -> None:
        """Find the errors that few rays make."""
        reference_photons, photons = self.by_rays.reference_photons, int(self.light.photons)
        reference = self._measurement(reference_photons, 999_999)
        exact = fisher_information(self.true, self.imager, reference, self.slopes)
        # Bounds and weights are those of the light that is quoted.
        share = photons / reference_photons
        quoted = replace(
            reference,
            images=share * reference.images,
            read_noise=self.light.read_noise,
        )
        information = fisher_information(self.true, self.imager, quoted, self.slopes)
        inverse = self._s21_inverse(reference)
        floor = float((exact.bounds / information.bounds).square().mean().sqrt())
        self.numbers["pose_error/reference_over_bound"] = floor
        for (name, imager), count in (
            (entry, count) for entry in self.imagers.items() for count in self.by_rays.counts
        ):
            found: dict[str, list[Tensor]] = {estimator: [] for estimator in ESTIMATORS}
            seconds = []
            for pattern in range(self.by_rays.patterns):
                own = replace(imager, rays=count, seed=pattern + 1)
                started = time.perf_counter()
                shares = torch.stack([image.image for image in self.true.images(own)])
                seconds.append(time.perf_counter() - started)
                modelled = replace(information, expected=shares)
                found["noise_weighted"].append(modelled.correction(quoted))
                found["s21"].append(self._s21_step(reference, own, inverse))
            for estimator, steps in found.items():
                rms = torch.stack(steps).square().mean(0).sqrt()
                self._add(f"rays/{name}", estimator, count, rms, information.bounds, min(seconds))
            logger.info("%s, %.3g rays: %s", name, count, self._last_ratios())

    # ---------------------------------------------------------------- where it starts

    def _basin(self) -> None:
        """Fit from starts that are farther and farther off."""
        self.basin.run()
        self.numbers |= self.basin.summary()

    # ---------------------------------------------------------------- estimates and rows

    def _s21_inverse(self, measurement: Measurement) -> Tensor:
        """Return the pseudo-inverse (P, rows) of S21's Jacobian with respect to u, at the truth.

        Another measurement's largest pixel scales all rows but those of the centroids a little
        otherwise, which moves the least squares by as little.
        """
        loss = SpotLoss(measurement, self.slopes, self.images.centroid_weight)
        every = torch.ones(len(self.true.names), dtype=torch.bool)
        return torch.linalg.pinv(loss.jacobian(self.true, every)[1])

    def _s21_step(self, measurement: Measurement, imager: SpotImager, inverse: Tensor) -> Tensor:
        """Return the step (P,) of S21 from the truth, in the units of θ."""
        loss = SpotLoss(measurement, imager, self.images.centroid_weight)
        return -self.true.scale * (inverse @ loss.residuals(self.true))

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
