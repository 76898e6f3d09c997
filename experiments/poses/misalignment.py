"""Poses of a lens, fitted to images of point sources (Section VI)."""

import copy
import itertools
import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from dolens.alignment.information import Knowledge, knowledge
from dolens.alignment.measurement import Measurement
from dolens.alignment.photograph import read_measurements
from dolens.alignment.pose import Pose
from dolens.alignment.unmodelled import Unmodelled, unmodelled_of
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.spot_image import SpotImage, SpotImager
from dolens.sensor.pixels import Sensor
from experiments.experiment import Experiment, Figures
from experiments.poses.estimates import Estimates, Held, estimates
from experiments.poses.iteration import iterate, loss_of, optimizer_of, slopes_of
from experiments.poses.measurements import draw, making, repetitions, simulated_at
from experiments.poses.misalignment_figures import misalignment_figures
from experiments.poses.results import (
    error_over_bound,
    pose_metrics,
    pose_rows,
    spread_columns,
    spread_metrics,
)
from experiments.poses.settings import Stage, fit_of, plain_imager, spot_imager, stage_of
from experiments.tables import Row, write_table

logger = logging.getLogger(__name__)

# Columns of a row of poses.csv that the log has too.
_LOGGED = 8


class MisalignmentModule(Experiment):
    """Fits poses one after another: an epoch is a fit, a step an iteration of one of its stages.

    Args:
        lens: as designed; its elements may have poses.
        experiment: name of the experiment; a checkpoint of another one is refused.
        sources: (S, 3), mm, in the lens's axes.
        wavelength: nm.
        sensor: the pixels; a measurement that is read brings its own.
        fits: name → `variables`, `truth`, and `held: {from, variables}`.
        stages: settings of `Stage`, in turn.
        imager: settings of `SpotImager` besides sensor and wavelength; see `spot_imager`.
        centroid_weight: μ of S21, 1/mm².
        photons: of each source, that pass the lens, in simulated measurements.
        read_noise: RMS, electrons.
        full_well: electrons; None: pixels do not saturate.
        measurement: settings of `read_measurement`, for a photograph in the place of a simulation,
            or a list of them, one for each source on each plane; the fits then have no truth.
        folder: of the run.
        monte_carlo: measurements with other photons and, where it has tolerances, another lens, for
            each fit, whose estimates (by steps of weighted least squares, from what the fits that
            they hold would have found) are compared with the bound and the truth; 0 for none.
        seed: of simulations.
        planes: where the sensor stands for a source's images, mm from `sensor_distance`.
        unmodelled: settings of `Unmodelled`: what simulated measurements have and the fit's model
            has not.

    Raises:
        InputError: a setting that is unknown or out of range.
    """

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        sources: Sequence[Sequence[float]],
        wavelength: float,
        sensor: Sensor,
        fits: Mapping[str, Mapping[str, Any]],
        stages: Sequence[Mapping[str, Any]],
        folder: str,
        imager: Mapping[str, Any] | None = None,
        centroid_weight: float = 1.0,
        photons: int = 4_000_000,
        read_noise: float = 2.0,
        full_well: float | None = None,
        measurement: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
        monte_carlo: int = 0,
        seed: int = 0,
        planes: Sequence[float] = (0.0,),
        unmodelled: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(lens, experiment, folder)
        self.automatic_optimization = False
        if lens.dtype != torch.float64:
            raise InputError(f"lens_dtype: poses are fitted in float64, not {lens.dtype}")
        self.seed = int(seed)
        self.unmodelled = unmodelled_of(unmodelled)
        self.measured = None
        if measurement is not None and self.unmodelled != Unmodelled():
            raise InputError("unmodelled: a photograph has effects of its own; leave them out")
        if measurement is not None:
            self.measured = read_measurements(measurement, len(sources) * len(planes))
            sensor = self.measured.sensor
        self.sensor, self.wavelength = sensor, float(wavelength)
        self.imager = dict(imager or {})
        self.centroid_weight = float(centroid_weight)
        self.photons, self.read_noise, self.full_well = int(photons), float(read_noise), full_well
        self.monte_carlo = repetitions(monte_carlo)
        self.stages = [stage_of(settings) for settings in stages]
        self.fits = [fit_of(name, settings) for name, settings in fits.items()]
        if not self.stages or not self.fits:
            raise InputError("misalignment: give at least one fit and one stage")
        for stage in self.stages:
            # A mistake in the last stage is found before the first one.
            plain_imager(sensor, self.wavelength, self.imager, stage.imager, stage.slopes)
        for number, fit in enumerate(self.fits):
            earlier = [before.name for before in self.fits[:number]]
            if fit.held_from is not None and fit.held_from not in earlier:
                raise InputError(
                    f"fits.{fit.name}.held.from: '{fit.held_from}' is no earlier fit; allowed: "
                    f"{', '.join(earlier) or 'none'}"
                )
        # Each has a lens of its own, since what an earlier one found is held in it.
        self.poses = nn.ModuleList(
            Pose(copy.deepcopy(lens), sources, fit.variables, planes) for fit in self.fits
        )
        for fit, pose in zip(self.fits, self.poses, strict=True):
            for name in (*fit.truth, *fit.held):
                pose.value(name)
            for stage in self.stages:
                unknown = set(stage.variables or ()) - set(pose.names)
                if unknown:
                    raise InputError(f"stages: variable '{unknown.pop()}' is not of fit {fit.name}")
        self.initial = [pose.scaled.detach().clone() for pose in self.poses]
        self.history: list[dict[str, float | str]] = []
        self.results: list[Row] = []
        self.known: dict[str, Knowledge] = {}
        self.estimates: dict[str, Estimates] = {}
        self.seconds: dict[str, float] = {}
        self._measurements: dict[int, Measurement] = {}

    # ---------------------------------------------------------------- what is measured

    def truth(self, number: int) -> dict[str, float]:
        """Return the true values of a fit, its own and those that it holds, degrees and mm.

        There are none where a photograph is fitted.
        """
        if self.measured is not None:
            return {}
        fit = self.fits[number]
        found: dict[str, float] = {}
        if fit.held_from is not None:
            before = self.truth(self._number(fit.held_from))
            found = {name: before[name] for name in fit.held if name in before}
        return {**found, **fit.truth}

    def true_pose(self, number: int) -> Pose:
        """Return the simulated lens and sources; values without a truth are as given."""
        pose = self.poses[number]
        true = Pose(copy.deepcopy(self.lens), pose.sources.tolist(), {}, pose.planes)
        true.put(self.truth(number))
        return true

    def measurement(self, number: int, seed: int = 0) -> Measurement:
        """Return the measurement that a fit is to explain."""
        if self.measured is not None:
            return self.measured
        if seed == 0 and number in self._measurements:
            return self._measurements[number]
        found = self.simulation(number, seed, self.unmodelled)
        if seed == 0:
            self._measurements[number] = found
        return found

    def simulation(self, number: int, seed: int, unmodelled: Unmodelled) -> Measurement:
        """Simulate one of a fit's measurements with these effects."""
        return simulated_at(
            self.true_pose(number),
            self.wavelength,
            self.sensor,
            self.photons,
            self.read_noise,
            draw(self.seed, number, seed),
            self.full_well,
            unmodelled,
            making(self.seed, seed),
        )

    def finest(self, number: int) -> SpotImager:
        """Return the imager of a fit's last stage, by which its result is judged."""
        settings = (self.imager, self.stages[-1].imager)
        return spot_imager(self.measurement(number), self.wavelength, *settings)

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
        if fit.held_from is None:
            return
        found = self.poses[self._number(fit.held_from)].found()
        pose.put({name: found[name] for name in fit.held})

    def _number(self, name: str) -> int:
        return [fit.name for fit in self.fits].index(name)

    def training_step(self, batch: Tensor, batch_idx: int) -> None:
        """Make one iteration of the present stage."""
        started = time.perf_counter()
        number, place = self.current_epoch, self._stage_at(batch_idx)
        stage = self.stages[place]
        optimizers = self.optimizers()
        # Of a single one Lightning makes no list.
        optimizers = optimizers if isinstance(optimizers, list) else [optimizers]
        optimizer = optimizers[number * len(self.stages) + place]
        measurement = self.measurement(number)
        loss = loss_of(stage, measurement, self.wavelength, self.imager, self.centroid_weight)
        bare = optimizer.optimizer
        # Lightning counts the steps of its own wrapping.
        terms = iterate(self.poses[number], stage, loss, bare, optimizer.step)
        self._record(number, place, stage, terms, bare, started)

    def _stage_at(self, iteration: int) -> int:
        """Return the number of the stage that an iteration of a fit belongs to."""
        ends = itertools.accumulate(stage.iterations for stage in self.stages)
        return next((i for i, end in enumerate(ends) if iteration < end), len(self.stages) - 1)

    def _record(
        self,
        number: int,
        place: int,
        stage: Stage,
        terms: Mapping[str, Tensor],
        optimizer: torch.optim.Optimizer,
        started: float,
    ) -> None:
        seconds = time.perf_counter() - started
        fit, pose = self.fits[number], self.poses[number]
        row: dict[str, float | str] = {
            "fit": fit.name,
            "stage": place + 1,
            "optimizer": stage.optimizer,
            "loss": float(sum(terms.values())),
            **{f"loss/{name}": float(value) for name, value in terms.items()},
            **pose.found(),
            "seconds": seconds,
        }
        last = getattr(optimizer, "last", None)
        if last is not None:
            row["damping"] = last.damping
        self.history.append(row)
        self.seconds[fit.name] = self.seconds.get(fit.name, 0.0) + seconds
        self.log("train/loss", row["loss"], prog_bar=True)
        numbers = {k: v for k, v in row.items() if isinstance(v, float)}
        for entry in self.loggers:
            entry.log_metrics(
                {f"{fit.name}/{name}": value for name, value in numbers.items()},
                step=self.global_step,
            )

    # ---------------------------------------------------------------- what was found

    @torch.no_grad()
    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        """Find errors and bounds of every fit; log them, and write the tables."""
        for number, (fit, pose) in enumerate(zip(self.fits, self.poses, strict=True)):
            self._hold(number)
            known = self._knowledge(number)
            self.known[fit.name] = known
            truth = self.truth(number)
            rows = pose_rows(fit.name, pose, self.initial[number], known, truth)
            self.log_dict(pose_metrics(rows))
            if self.monte_carlo and self.measured is None:
                draws = range(1, self.monte_carlo + 1)
                found = self._estimates(number, draws, self.unmodelled, self.estimates)
                self.estimates[fit.name] = found
                values = found.values[found.settled]
                self.log(f"pose_unsettled/{fit.name}", float(len(draws) - len(values)))
                spread = (fit.name, pose.names, values, known.bounds / pose.units, truth)
                if len(values) > 1:
                    self.log_dict(spread_metrics(*spread))
                rows = spread_columns(rows, *spread[1:])
            self.results += rows
        write_table(self.folder / "history.csv", self.history)
        write_table(self.folder / "poses.csv", self.results)
        for row in self.results:
            logger.info(
                "%s %s: true %.5g, initial %.5g, found %.5g, error %.2g, bound %.2g (%.2g if all "
                "that it holds were exact)",
                *list(row.values())[:_LOGGED],
            )

    def _slopes(self, number: int) -> tuple[SpotImager, float]:
        """Return the imager for derivatives of a fit's images, and their blur in pixels."""
        return slopes_of(self.stages[-1], self.measurement(number), self.wavelength, self.imager)

    def _knowledge(self, number: int) -> Knowledge:
        """Return the information on a fit's pose, with the uncertainty of values that it holds."""
        fit, pose, measurement = self.fits[number], self.poses[number], self.measurement(number)
        own, finest = self._slopes(number), self.finest(number)
        if fit.held_from is None:
            return knowledge(pose, finest, measurement, *own)
        both = pose.varying({**pose.settings, **dict.fromkeys(fit.held)})
        before = self.known[fit.held_from]
        places = [before.names.index(name) for name in fit.held]
        covariance = before.covariance[places][:, places]
        known = knowledge(both, finest, measurement, *own)
        return known.holding(len(pose.names), covariance)

    def _estimates(
        self,
        number: int,
        draws: Sequence[int],
        unmodelled: Unmodelled,
        earlier: Mapping[str, Estimates],
    ) -> Estimates:
        """Estimate the pose from other measurements, by steps from where the fit ended."""
        fit, pose = self.fits[number], self.poses[number]
        held = None
        if fit.held_from is not None:
            before = self.poses[self._number(fit.held_from)]
            places = [before.names.index(name) for name in fit.held]
            units, truth = before.units[places], self.truth(number)
            held = Held(
                fit.held,
                units,
                (before.scale * before.scaled.detach())[places],
                earlier[fit.held_from].values[:, places] * units,
                torch.tensor([truth.get(n, torch.nan) for n in fit.held]).double() * units,
            )
        return estimates(
            pose,
            self.known[fit.name],
            self.finest(number),
            lambda seed: self.simulation(number, seed, unmodelled),
            draws,
            self.truth(number),
            held,
            self._slopes(number)[0],
        )

    def images(self, number: int, scaled: Tensor | None = None) -> list[SpotImage]:
        """Return the images of a fit's pose, or of other values u of its variables."""
        self._hold(number)
        with torch.no_grad():
            return self.poses[number].images(self.finest(number), scaled)

    def figures(self) -> Figures:
        """Return images before and after, the convergence of each fit, and bounds of its pose."""
        return misalignment_figures(self)

    def summary(self) -> dict[str, float]:
        """Return what the run cost, and errors over bounds where the truth is known."""
        numbers = {f"cost/{name}_s": value for name, value in self.seconds.items()}
        numbers["cost/iterations"] = float(len(self.history))
        images = len(self.measurement(0).images)
        numbers["cost/rays"] = float(self.finest(0).rays * images)
        ratio = error_over_bound(self.results)
        if ratio is not None:
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
