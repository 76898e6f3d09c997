"""Poses of a lens, fitted to images of point sources (Section VI)."""

import copy
import itertools
import logging
import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from dolens.alignment.information import FisherInformation, fisher_information
from dolens.alignment.measurement import Light, Measurement
from dolens.errors import check_choice
from dolens.experiments.experiment import Experiment, Figures
from dolens.experiments.poses.bench import Bench, Observations, check_precision, repetitions
from dolens.experiments.poses.fit_plan import FitPlan, Stage, values_imager
from dolens.experiments.poses.fitting import (
    Estimates,
    estimates,
    held_numbers,
    iterate,
    loss_of,
    optimizer_of,
    slopes_of,
)
from dolens.experiments.poses.pose_figures import image_labels
from dolens.experiments.poses.pose_results import (
    error_over_bound,
    history_row,
    pose_metrics,
    pose_rows,
    spread_columns,
    spread_metrics,
)
from dolens.experiments.tables import Row, write_table
from dolens.experiments.workers import workers_of
from dolens.optics.lens import Lens
from dolens.plotting.layout import lens_title
from dolens.plotting.parameter_fits import convergence_figure, corner_figure
from dolens.plotting.pictures import spot_fit_figure
from dolens.plotting.tolerances import parameter_label
from dolens.rendering.spot_image import SpotImage, SpotImager
from dolens.tasks import TaskMap
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)

# Columns of a row of poses.csv that the log has too.
_LOGGED = 8


class MisalignmentModule(Experiment):
    """Fits poses one after another: an epoch is a fit, a step an iteration of one of its stages.

    Args:
        lens: as designed; its elements may have poses.
        bench: sources, sensor and planes; a photograph brings a sensor of its own.
        light: light and noise of simulated measurements.
        plan: the fits and their stages.
        measurement: settings of `read_measurement`, for a photograph in the place of a simulation,
            or a list of them, one for each source on each plane; the fits then have no truth.
        monte_carlo: measurements with other photons and, where it has tolerances, another lens, for
            each fit, whose estimates (by steps of weighted least squares, from what the fits that
            they hold would have found) are compared with the bound and the truth; 0 for none.
        seed: of simulations.
        workers: where the estimates from other measurements are found; see `workers_of`.

    Raises:
        InputError: a setting that is unknown or out of range.
    """

    metrics = (
        "pose_error/over_bound",
        "pose_error/*/*",
        "pose/*",
        "pose_bound/*",
        "pose_unsettled/*",
        "pose_spread_over_bound/*",
        "pose_bias_over_bound/*",
        "pose_coverage/*",
        "pose_within_1_bound/*",
        "pose_within_2_bounds/*",
        "train/loss",
    )

    def __init__(
        self,
        lens: Lens,
        bench: Bench,
        light: Light,
        plan: FitPlan,
        measurement: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
        monte_carlo: int = 0,
        seed: int = 0,
        workers: int | str | None = None,
    ) -> None:
        super().__init__(lens)
        self.workers = workers_of(workers)
        self.automatic_optimization = False
        check_precision(lens, "fitted")
        self.plan, self.fits, self.stages, self.light = plan, plan.fits, plan.stages, light
        self.observations = Observations(lens, bench, light, plan.fits, measurement, int(seed))
        self.bench = self.observations.bench
        self.sensor, self.wavelength = self.bench.sensor, self.bench.wavelength
        self.monte_carlo = repetitions(monte_carlo)
        plan.check_imagers(self.sensor, self.wavelength)
        # Each has a lens of its own, since what an earlier one found is held in it.
        self.poses = nn.ModuleList(
            bench.pose(copy.deepcopy(lens), fit.variables) for fit in self.fits
        )
        for fit, pose in zip(self.fits, self.poses, strict=True):
            for name in (*fit.truth, *fit.held):
                pose.check_name(name)
            for stage in self.stages:
                for name in stage.variables or ():
                    check_choice(name, pose.names, f"stages: variable of fit {fit.name}")
        self.initial = [pose.scaled.detach().clone() for pose in self.poses]
        self.history: list[dict[str, float | str]] = []
        self.results: list[Row] = []
        self.information: dict[str, FisherInformation] = {}
        self.estimates: dict[str, Estimates] = {}
        self.seconds: dict[str, float] = {}

    # ---------------------------------------------------------------- what is measured

    def truth(self, number: int) -> dict[str, float]:
        """Return the true numbers of a fit, by name; none where a photograph is fitted."""
        return self.observations.truth(number)

    def measurement(self, number: int) -> Measurement:
        """Return what a fit is to explain."""
        return self.observations.measured(number)

    def finest(self, number: int) -> SpotImager:
        """Return the imager of a fit's last stage, by which its result is judged."""
        settings = (self.plan.imager, self.stages[-1].imager)
        return values_imager(self.measurement(number), self.wavelength, *settings)

    # ---------------------------------------------------------------- iterations

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """Return an optimizer for each stage of each fit; a checkpoint holds them all."""
        return [optimizer_of(stage, pose) for pose in self.poses for stage in self.stages]

    def on_train_epoch_start(self) -> None:
        """Put the values that the fit holds to those that an earlier fit has found."""
        self._hold(self.current_epoch)

    def on_train_start(self) -> None:
        """Do the same when a run is resumed within a fit."""
        self._hold(min(self.current_epoch, len(self.fits) - 1))

    def _hold(self, number: int) -> None:
        fit, pose = self.fits[number], self.poses[number]
        if fit.held_from is not None:
            found = self.poses[self.plan.number(fit.held_from)].file_values()
            pose.put({name: found[name] for name in fit.held})

    def training_step(self, batch: Tensor, batch_idx: int) -> None:
        """Make one iteration of the present stage."""
        started = time.perf_counter()
        number, place = self.current_epoch, self.plan.stage_at(batch_idx)
        stage = self.stages[place]
        optimizers = self.optimizers()
        # Of a single one Lightning makes no list.
        optimizers = optimizers if isinstance(optimizers, list) else [optimizers]
        optimizer = optimizers[number * len(self.stages) + place]
        loss = loss_of(
            stage,
            self.measurement(number),
            self.wavelength,
            self.plan.imager,
            self.plan.centroid_weight,
        )
        bare = optimizer.optimizer
        # Lightning counts the steps of its own wrapping.
        terms = iterate(self.poses[number], stage, loss, bare, optimizer.step)
        seconds = time.perf_counter() - started
        fit, pose = self.fits[number], self.poses[number]
        self._record(number, history_row(fit.name, place, stage, pose, terms, bare, seconds))

    def _record(self, number: int, row: dict[str, float | str]) -> None:
        """Log an iteration of a fit, and keep it."""
        fit = self.fits[number]
        self.history.append(row)
        self.seconds[fit.name] = self.seconds.get(fit.name, 0.0) + row["seconds"]
        self.log("train/loss", row["loss"], prog_bar=True)
        numbers = {f"{fit.name}/{k}": v for k, v in row.items() if isinstance(v, float)}
        for entry in self.loggers:
            entry.log_metrics(numbers, step=self.global_step)

    # ---------------------------------------------------------------- what was found

    @torch.no_grad()
    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        """Find errors and bounds of every fit; log them, and write the tables."""
        with self.workers.open() as map_tasks:
            for number, (fit, pose) in enumerate(zip(self.fits, self.poses, strict=True)):
                self._hold(number)
                with named_stage(f"bounds: {fit.name}"):
                    information = self._information(number)
                self.information[fit.name] = information
                truth = self.truth(number)
                rows = pose_rows(fit.name, pose, self.initial[number], information, truth)
                self.log_dict(pose_metrics(rows))
                if self.monte_carlo and self.observations.photograph is None:
                    draws = range(1, self.monte_carlo + 1)
                    with named_stage(f"{len(draws)} measurements drawn: {fit.name}"):
                        found = self._estimates(
                            number, draws, self.light, self.estimates, map_tasks
                        )
                    self.estimates[fit.name] = found
                    values = found.values[found.settled]
                    self.log(f"pose_unsettled/{fit.name}", float(len(draws) - len(values)))
                    spread = (fit.name, pose.names, values, information.bounds / pose.units, truth)
                    if len(values) > 1:
                        self.log_dict(spread_metrics(*spread))
                    rows = spread_columns(rows, *spread[1:])
                self.results += rows
        if self.folder is not None:
            write_table(self.folder / "history.csv", self.history)
            write_table(self.folder / "poses.csv", self.results)
        for row in self.results:
            logger.info(
                "%s %s: true %.5g, initial %.5g, found %.5g, error %.2g, bound %.2g (%.2g if all "
                "that it holds were exact)",
                *list(row.values())[:_LOGGED],
            )

    def _slopes(self, number: int) -> tuple[SpotImager, float]:
        """Return what makes derivatives of a fit's images, and their blur, pixels."""
        return slopes_of(
            self.stages[-1], self.measurement(number), self.wavelength, self.plan.imager
        )

    def _information(self, number: int) -> FisherInformation:
        """Return the information on a fit's pose, with the uncertainty of what it holds."""
        fit, pose, measurement = self.fits[number], self.poses[number], self.measurement(number)
        own, finest = self._slopes(number), self.finest(number)
        if fit.held_from is None:
            return fisher_information(pose, finest, measurement, *own)
        both = pose.varying({**pose.settings, **dict.fromkeys(fit.held)})
        before = self.information[fit.held_from]
        places = [before.names.index(name) for name in fit.held]
        covariance = before.covariance[places][:, places]
        information = fisher_information(both, finest, measurement, *own)
        return information.with_nuisance_parameters(len(pose.names), covariance)

    def _estimates(
        self,
        number: int,
        draws: Sequence[int],
        light: Light,
        earlier: Mapping[str, Estimates],
        map_tasks: TaskMap,
    ) -> Estimates:
        """Return what other measurements lead to, from where a fit ended.

        Args:
            number: of the fit.
            draws: numbers of measurements.
            light: of them.
            earlier: estimates from them by earlier fits, whose numbers this one may hold.
            map_tasks: finds the estimates.
        """
        fit, pose, truth = self.fits[number], self.poses[number], self.truth(number)
        held = None
        if fit.held_from is not None:
            before = self.poses[self.plan.number(fit.held_from)]
            held = held_numbers(fit, before, earlier[fit.held_from], truth)
        return estimates(
            pose,
            self.information[fit.name],
            self.finest(number),
            partial(self.observations.simulated, number, light=light),
            draws,
            truth,
            held,
            self._slopes(number)[0],
            map_tasks,
        )

    def images(self, number: int, scaled: Tensor | None = None) -> list[SpotImage]:
        """Return the images of a fit's pose, or of other values u of its variables."""
        self._hold(number)
        with torch.no_grad():
            return self.poses[number].images(self.finest(number), scaled)

    def figures(self) -> Figures:
        """Return `spots`, and for each fit `convergence_<fit>` and `corner_<fit>`.

        A fit that made no iteration has no convergence.
        """
        figures = {"spots": partial(_spots, self)}
        for number, fit in enumerate(self.fits):
            if any(row["fit"] == fit.name for row in self.history):
                figures[f"convergence_{fit.name}"] = partial(_convergence, self, number)
            figures[f"corner_{fit.name}"] = partial(_corner_of_fit, self, number)
        return figures

    def summary(self) -> dict[str, float]:
        """Return what the run cost, and errors over bounds where the truth is known."""
        numbers = {f"cost/{name}_s": value for name, value in self.seconds.items()}
        numbers["cost/iterations"] = float(len(self.history))
        numbers["cost/rays"] = float(self.finest(0).rays * len(self.measurement(0).images))
        if (ratio := error_over_bound(self.results)) is not None:
            numbers["pose_error/over_bound"] = ratio
        return numbers

    # ---------------------------------------------------------------- checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the history of iterations, and the seconds of each fit."""
        return {"history": self.history, "seconds": self.seconds}

    def load_checkpoint_state(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on with them."""
        self.history = list(checkpoint.get("history", []))
        self.seconds = dict(checkpoint.get("seconds", {}))

    def identity(self) -> dict[str, Any]:
        """Return the experiment, the lens, the fits and the stages."""
        return {
            **super().identity(),
            "fits": {fit.name: list(fit.variables) for fit in self.fits},
            "stages": [[stage.optimizer, stage.iterations] for stage in self.stages],
        }


_LOSS_LABELS = {"s21": "loss S21 (no unit)", "noise_weighted": "χ² per pixel (no unit)"}


def _spots(fitted: MisalignmentModule) -> Figure:
    measured, initial, final, labels = [], [], [], []
    for number, fit in enumerate(fitted.fits):
        measurement = fitted.measurement(number)
        shares = measurement.shares
        measured.append(shares)
        for kept, scaled in ((initial, fitted.initial[number]), (final, None)):
            images = enumerate(fitted.images(number, scaled))
            kept.append(torch.stack([measurement.as_seen(image, s)[0] for s, image in images]))
        pose = fitted.poses[number]
        labels += [f"fit {fit.name}{of}" for of in image_labels(len(pose.sources), pose.planes)]
    return spot_fit_figure(
        torch.cat(measured),
        torch.cat(initial),
        torch.cat(final),
        labels,
        fitted.sensor.pixel_pitch,
        f"{lens_title(fitted.lens)}\nimages of point sources, measured and modelled",
    )


def _convergence(fitted: MisalignmentModule, number: int) -> Figure:
    fit, pose = fitted.fits[number], fitted.poses[number]
    rows = [row for row in fitted.history if row["fit"] == fit.name]
    stages = [
        (optimizer, len(list(group)))
        for (_, optimizer), group in itertools.groupby(
            rows, key=lambda row: (row["stage"], row["optimizer"])
        )
    ]
    values = {
        parameter_label(name): ([float(row[name]) for row in rows], unit)
        for name, unit in zip(pose.names, pose.unit_names, strict=True)
    }
    truth = fitted.truth(number)
    return convergence_figure(
        _losses(fitted.stages, rows),
        values,
        stages,
        {parameter_label(name): truth[name] for name in pose.names if name in truth},
        f"{lens_title(fitted.lens)}\nconvergence of fit {fit.name}",
    )


def _losses(stages: Sequence[Stage], rows: Sequence[Row]) -> dict[str, list[float]]:
    """Return the losses by name, NaN in stages of another one."""
    # Stages count from 1 in the history.
    of_stage = [str(stages[int(row["stage"]) - 1].loss) for row in rows]
    found = [float(row["loss"]) for row in rows]
    return {
        _LOSS_LABELS.get(name, name): [
            value if own == name else math.nan for value, own in zip(found, of_stage, strict=True)
        ]
        for name in dict.fromkeys(of_stage)
    }


def _corner_of_fit(fitted: MisalignmentModule, number: int) -> Figure:
    fit, pose = fitted.fits[number], fitted.poses[number]
    units = pose.units.cpu()
    covariance = fitted.information[fit.name].covariance.cpu() / torch.outer(units, units)
    found = torch.tensor([pose.file_values()[name] for name in pose.names], dtype=torch.float64)
    truth = fitted.truth(number)
    true = torch.tensor([truth.get(name, math.nan) for name in pose.names], dtype=torch.float64)
    estimates = fitted.estimates.get(fit.name)
    points = None if estimates is None else estimates.values
    # Estimates scatter about the truth, where that is known; the truth lies about one estimate.
    about_truth = points is not None and bool(true.isfinite().all())
    return corner_figure(
        covariance,
        [parameter_label(name) for name in pose.names],
        pose.unit_names,
        true if about_truth else found,
        points,
        true if truth else None,
        f"{lens_title(fitted.lens)}\nhow well fit {fit.name} knows its pose (Cramér–Rao)",
    )
