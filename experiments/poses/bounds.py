"""Cramér–Rao bounds of a lens's pose for arrangements of sources and planes."""

import copy
import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.information import FisherInformation, fisher_information
from dolens.alignment.measurement import Light, Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError, check_keys
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.poses.bench import (
    Bench,
    check_precision,
    draw,
    repetitions,
    simulate,
)
from dolens.experiments.poses.fit_plan import ImageSettings, blur_for, slopes_imager, values_imager
from dolens.experiments.poses.pose_figures import UNSEEN, Arrangement, bounds_figures
from dolens.experiments.poses.pose_results import spread_metrics
from dolens.experiments.tables import Row
from dolens.experiments.workers import workers_of
from dolens.optics.lens import Lens
from dolens.plotting.layout import lens_title

logger = logging.getLogger(__name__)

_KEYS = ("sources", "planes", "variables")


class PoseBoundsModule(Analysis):
    """Compares arrangements of sources and planes by their bounds of the same unknowns.

    Args:
        lens: as designed; its elements may have poses.
        bench: wavelength and sensor; arrangements have sources and planes of their own.
        light: light and noise; its photons are those of all images of an arrangement together.
        values: where the lens and the sources are, by name, degrees and mm.
        variables: name → settings of `Pose`: what is unknown.
        arrangements: name → `sources` (S, 3), mm; `planes`, mm; and `variables`, names that are
            unknown here besides those of all.
        images: settings of the model's images.
        monte_carlo: measurements with other photons, of each arrangement, whose estimates are
            compared with the bounds; 0 for none.
        seed: of simulations.
        workers: where arrangements and measurements are worked out; see `workers_of`.

    Raises:
        InputError: a setting that is unknown or out of range.
    """

    metrics = (
        "knowledge/*/worst",
        "knowledge/*/unseen",
        "pose_bound/*",
        "pose_spread_over_bound/*",
        "pose_bias_over_bound/*",
        "pose_coverage/*",
        "pose_within_1_bound/*",
        "pose_within_2_bounds/*",
    )

    def __init__(
        self,
        lens: Lens,
        bench: Bench,
        light: Light,
        values: Mapping[str, float],
        variables: Mapping[str, Mapping[str, Any] | None],
        arrangements: Mapping[str, Mapping[str, Any]],
        images: ImageSettings,
        monte_carlo: int = 0,
        seed: int = 0,
        workers: int | str | None = None,
    ) -> None:
        super().__init__(lens)
        self.workers = workers_of(workers)
        check_precision(lens, "known")
        if not variables or not arrangements:
            raise InputError("variables, arrangements: give at least one of each")
        self.seed = int(seed)
        self.bench, self.light, self.images = bench, light, images
        self.monte_carlo = repetitions(monte_carlo)
        self.poses = {
            name: self._pose(name, entry, values, variables) for name, entry in arrangements.items()
        }
        self.arrangements: list[Arrangement] = []

    @torch.no_grad()
    def analyse(self) -> dict[str, float]:
        """Evaluate every arrangement, then draw the measurements of each."""
        numbers: dict[str, float] = {}
        poses = list(self.poses.values())
        model = BoundsModel(self.bench, self.light, self.images, self.seed)
        draws = range(1, self.monte_carlo + 1)
        with self.workers.open() as map_tasks:
            found = list(map_tasks(model.information, list(enumerate(poses)), "arrangements"))
            tasks = [(number, draw) for number in range(len(poses)) for draw in draws]
            moved = map_tasks(partial(model.correction, poses, found), tasks, "measurements")
            for name, pose, information in zip(self.poses, poses, found, strict=True):
                steps = list(itertools.islice(moved, len(draws)))
                arrangement = self._arrangement(name, pose, information, steps)
                self.arrangements.append(arrangement)
                numbers |= self._metrics(arrangement)
                logger.info("%s: %s", name, self._verdict(arrangement))
        return numbers

    def tables(self) -> dict[str, list[Row]]:
        """Return `bounds` and `eigenvectors`."""
        return {"bounds": self.bound_rows(), "eigenvectors": self.eigenvector_rows()}

    def figures(self) -> Figures:
        """Return `knowledge`, and `corner_<arrangement>` where all variables can be seen."""
        return bounds_figures(self.arrangements, lens_title(self.lens), int(self.light.photons))

    def bound_rows(self) -> list[Row]:
        """Return rows of bounds.csv, one for each variable of each arrangement."""
        rows: list[Row] = []
        for found in self.arrangements:
            names, correlations = found.pose.names, found.information.correlations
            for place, name in enumerate(names):
                others = correlations[place].abs().clone()
                others[place] = -1.0
                other = int(others.argmax())
                rows.append(
                    {
                        "arrangement": found.name,
                        "variable": name,
                        "value": found.pose.file_values()[name],
                        "bound": float(found.bounds[place]),
                        "most_like": names[other],
                        "correlation": float(correlations[place, other]),
                    }
                )
        return rows

    def eigenvector_rows(self) -> list[Row]:
        """Return rows of eigenvectors.csv, the one with the largest variance first."""
        return [
            {
                "arrangement": found.name,
                "standard_deviation": float(spread),
                **dict(zip(found.pose.names, vector.tolist(), strict=True)),
            }
            for found in self.arrangements
            for spread, vector in zip(found.spread, found.eigenvectors, strict=True)
        ]

    def _pose(
        self,
        name: str,
        entry: Mapping[str, Any],
        values: Mapping[str, float],
        variables: Mapping[str, Mapping[str, Any] | None],
    ) -> Pose:
        """Return the lens where it is, with the unknowns of an arrangement as variables."""
        check_keys(entry, _KEYS, f"arrangements.{name}")
        if not entry.get("sources"):
            raise InputError(
                f"arrangements.{name}: sources are missing; give one (x, y, z) or more"
            )
        bench = replace(self.bench, sources=entry["sources"], planes=entry.get("planes") or (0.0,))
        place = bench.pose(copy.deepcopy(self.lens))
        place.put(values)
        return place.varying({**variables, **(entry.get("variables") or {})})

    def _arrangement(
        self, name: str, pose: Pose, information: FisherInformation, moved: Sequence[Tensor]
    ) -> Arrangement:
        spread, eigenvectors = information.eigenvectors(pose.scale)
        estimates = None
        if moved:
            theta = pose.scale * pose.scaled.detach()
            estimates = (theta + torch.stack(list(moved))) / pose.units
        return Arrangement(name, pose, information, spread, eigenvectors, estimates)

    def _metrics(self, found: Arrangement) -> dict[str, float]:
        numbers = {
            f"pose_bound/{found.name}/{name}": float(bound)
            for name, bound in zip(found.pose.names, found.bounds, strict=True)
        }
        numbers[f"knowledge/{found.name}/worst"] = min(float(found.spread[0]), UNSEEN)
        numbers[f"knowledge/{found.name}/unseen"] = float((found.spread > UNSEEN).sum())
        if found.estimates is not None:
            truth = found.pose.file_values()
            numbers |= spread_metrics(
                found.name, found.pose.names, found.estimates, found.bounds, truth
            )
        return numbers

    def _verdict(self, found: Arrangement) -> str:
        """Return the eigenvector with the largest variance, in words."""
        worst = found.eigenvectors[0]
        order = worst.abs().argsort(descending=True)
        names = [
            f"{float(worst[i]):+.2f} {found.pose.names[int(i)]}"
            for i in order
            if abs(float(worst[i])) > 0.1
        ]
        spread = float(found.spread[0])
        if not spread < UNSEEN:
            return f"{' '.join(names)} (of their scales) cannot be seen at all"
        return f"known worst, to {spread:.2g} of their scales: {' '.join(names)}"


@dataclass(frozen=True)
class BoundsModel:
    """Describes how arrangements are measured and modelled.

    Attributes:
        bench: wavelength and sensor.
        light: its photons are those of all images of an arrangement together.
        images: settings of the model's.
        seed: of simulations.
    """

    bench: Bench
    light: Light
    images: ImageSettings
    seed: int

    @torch.no_grad()
    def information(self, task: tuple[int, Pose]) -> FisherInformation:
        """Return the information that an arrangement's images carry on its pose.

        Args:
            task: the arrangement's number and pose.
        """
        number, pose = task
        measured = self._measurement(number, pose, 0)
        wavelength, settings = self.bench.wavelength, self.images
        own = values_imager(measured, wavelength, settings.imager)
        slopes = slopes_imager(measured, wavelength, settings.imager, settings.slopes)
        return fisher_information(pose, own, measured, slopes, blur_for(measured, slopes))

    @torch.no_grad()
    def correction(
        self,
        poses: Sequence[Pose],
        information: Sequence[FisherInformation],
        task: tuple[int, int],
    ) -> Tensor:
        """Return the step (P,) from a pose to what another measurement leads to.

        Args:
            poses: of all arrangements.
            information: on them.
            task: numbers of the arrangement and of the measurement.
        """
        number, drawn = task
        return information[number].correction(self._measurement(number, poses[number], drawn))

    def _measurement(self, number: int, pose: Pose, measurement: int) -> Measurement:
        count = len(pose.sources) * len(pose.planes)
        light = replace(self.light, photons=max(1, int(self.light.photons) // count))
        return simulate(pose, self.bench, light, draw(self.seed, number, measurement))
