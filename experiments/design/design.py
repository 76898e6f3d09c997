"""Design of a lens by a merit function."""

import copy
import logging
import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.experiments.design.design_figures import design_figures, history_figures, state_figures
from dolens.experiments.design.iteration import (
    Progress,
    gradient_iteration,
    iteration_row,
    least_squares_iteration,
)
from dolens.experiments.design.states import (
    entrance_pupils,
    fit_edges,
    foci,
    set_entrance_pupils,
    set_foci,
    spot_metrics,
    state_metrics,
)
from dolens.experiments.experiment import Experiment, Figures
from dolens.experiments.settings import check_positive
from dolens.optics.lens import Lens
from dolens.optimize import DesignVariables, MeritFunction, MeritSettings
from dolens.optimize.merit import MeritValue
from dolens.optimize.rounds import refuse_lost_light
from dolens.optimize.states import StatesMerit, StatesValue
from dolens.optimize.variables import start_values
from dolens.prescriptions import lens_from_prescription
from dolens.tasks import stage

logger = logging.getLogger(__name__)

SEMI_DIAMETERS = ("fixed", "automatic")
# So many iterations are logged one by one; history.csv holds all.
_LOGGED_FIRST = 20
# Of merit functions without operands.
_MERIT_UNITS = {"spots": "µm²", "wavefront": "λ²"}


class DesignModule(Experiment):
    """Searches for the lens of the least merit.

    A step is an iteration of the optimizer.  An epoch is a round: it begins by choosing the rays
    that pass the lens as it then is, and ends when the optimizer says that nothing is to be gained,
    or after as many iterations as the data give.  The lens of the best round is kept.

    Args:
        lens: the lens; `start` moves it first.
        variables: settings of `DesignVariables`.
        merit: the merit function.
        optimizer: parameter groups → optimizer; one that takes residuals, as `DampedLeastSquares`,
            gets them, every other one the gradient of the merit.
        start: settings of `start_values`; None begins at the prescription.
        published: a prescription to compare with, or None.
        evaluation: what RMS spot radii are reported of; None: the merit's own rays.
        semi_diameters: `fixed`: light passes where the prescription lets it; or `automatic`: the
            rays that pass the lens where the search begins are kept, and in the end every edge, and
            the stop's, is put where they pass; with `keep_pupils` each round's own rays are, and
            every round begins with its edges.
        round_tolerance: a round that lowers the merit by a smaller part is the last.
        seed: of the errors in `start`.
        mtf_max_frequency: the end of the MTF curves in figures, cycles/mm; see `design_figures`.
        keep_pupils: whether the stop opens or closes to the entrance pupils of the prescription,
            where the search begins and with every round; in every state to its own.

    Attributes:
        initial: the lens where the search began.
        history: a row of numbers for every iteration.
        initial_merit: the merit before the first iteration; NaN where nothing was trained.

    Raises:
        InputError: a setting that is out of range, or no variables.
    """

    metrics = (
        "rms_spot_um/initial",
        "rms_spot_um/final",
        "rms_spot_um/published",
        "rms_spot_um/published_refocused",
        "rms_spot_um/*/*",
        "light/*",
        "transmission/*",
        "train/merit",
        "train/*",
        "val/merit",
        "error/sampling_um",
    )

    def __init__(
        self,
        lens: Lens,
        variables: Mapping[str, Mapping[str, Any] | None] | None,
        merit: MeritSettings,
        optimizer: Callable[..., torch.optim.Optimizer],
        start: Mapping[str, Any] | None,
        published: Mapping[str, Any] | None,
        evaluation: MeritSettings | None,
        semi_diameters: str,
        round_tolerance: float,
        seed: int,
        mtf_max_frequency: float | None,
        keep_pupils: bool = False,
    ) -> None:
        super().__init__(lens)
        self.automatic_optimization = False
        generator = torch.Generator().manual_seed(seed)
        values = start_values(lens, start or {}, generator)
        self._pupils = entrance_pupils(lens) if keep_pupils else {}
        with torch.no_grad():
            for name, parameter in lens.variables(list(values)).items():
                parameter.copy_(values[name])
        self.variables = DesignVariables(lens, variables or {})
        if not len(self.variables):
            raise InputError("variables: there are none; name a parameter, as surfaces.*.curvature")
        self.variables.project()
        self.variables.write_to(self.lens)
        set_entrance_pupils(self.lens, self._pupils)
        # In a tuple, so that checkpoints do not hold them.
        self._initial = (copy.deepcopy(self.lens),)
        self.published = None
        if published is not None:
            model = {"index_model": lens.index_model}
            self.published = lens_from_prescription(
                {**published, **model}, lens.dtype, where="published", backend=lens.backend
            )
        self.merit_settings = merit
        self.evaluation = evaluation or replace(
            merit, quality="spots", quality_options={}, operands=()
        )
        self.optimizer, self.round_tolerance = optimizer, round_tolerance
        if mtf_max_frequency is not None:
            check_positive("mtf_max_frequency", mtf_max_frequency)
        self.mtf_max_frequency = mtf_max_frequency
        check_choice(semi_diameters, SEMI_DIAMETERS, "semi_diameters")
        self.automatic_semi_diameters = semi_diameters == "automatic"
        if self.automatic_semi_diameters:
            self.merit_settings = replace(merit, max_vignetting=1.0)
        if not 0.0 <= round_tolerance < 1.0:
            raise InputError(f"round_tolerance: {round_tolerance}; allowed: 0 to 1")
        self.merit: MeritFunction | StatesMerit | None = None
        self.history: list[dict[str, float]] = []
        self.initial_merit = math.nan
        self._stopped: str | None = None
        # The best merit before the round that ended last, and its own; None within a round.
        self._ended: tuple[float, float] | None = None
        # Where the round began, so that a resumed one has its rays; and the best round's end.
        for name in ("round_start", "best"):
            self.register_buffer(name, self.variables.scaled.detach().clone())
        # The sensor of the lens, or those of its states that are kept at their best focus.
        of_states = sorted(self.variables.focused) if len(lens.states) else ["sensor_distance"]
        self._focus_names = of_states
        for name in ("round_start_focus", "best_focus"):
            self.register_buffer(name, foci(self.lens, of_states))
        self.register_buffer("best_merit", torch.tensor(math.inf, dtype=torch.float64))
        self._fit_seconds = self._left = 0.0
        self._between: list[float] = []
        self.initial_light: dict[str | None, Tensor] = {}

    @property
    def initial(self) -> Lens:
        """Return the lens where the search began."""
        return self._initial[0]

    # ---------------------------------------------------------------- rounds

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return an optimizer of one group, which holds the variables and their bounds."""
        return self.optimizer([self.variables.parameter_group()])

    def on_fit_start(self) -> None:
        """Start the clock."""
        self._fit_started = time.perf_counter()

    def on_train_start(self) -> None:
        """Choose the rays of the first round, or of the one that a checkpoint was in."""
        lens = copy.deepcopy(self.lens)
        with torch.no_grad():
            now = self.variables.scaled.clone()
            self.variables.scaled.copy_(self.round_start)
            self.variables.write_to(lens)
            set_foci(lens, self._focus_names, self.round_start_focus)
            self.variables.scaled.copy_(now)
        with stage("choosing the rays"):
            self.merit = self._build(lens)
        fresh = math.isinf(float(self.best_merit))
        begun = self.merit if fresh else self.merit_settings.build(self.initial, self.variables)
        self.initial_light = {n: quality.spots.light for n, quality in begun.qualities.items()}
        if fresh:
            self._keep_if_better(self.merit())
            self.initial_merit = float(self.best_merit)
            if not math.isfinite(float(self.best_merit)):
                raise InputError(
                    "the search cannot begin: rays fail, or apertures clip more than "
                    "merit.max_vignetting of a spot"
                )
        logger.info(
            "%d variables, %d rays of %d launched, merit %.6g",
            self.variables.scaled.numel(),
            self.rays,
            self.rays_launched,
            float(self.best_merit),
        )
        self._go_on()

    def _go_on(self) -> None:
        """Go on from a checkpoint as if nothing had been in between: a search that ended ends."""
        optimizer = self.optimizers().optimizer
        if self._ended is None:
            self._stopped = getattr(optimizer, "stopped", None)
        elif self._is_last(*self._ended):
            self.trainer.should_stop = True
        elif hasattr(optimizer, "restart"):  # the tolerance of rounds is another one now
            optimizer.restart()

    def _is_last(self, before: float, reached: float) -> bool:
        """Return whether a round gained so little that no other follows."""
        gained, least = before - reached, self.round_tolerance * before
        # With pupils of its own a round begins with other edges, and may end worse than the best.
        return abs(gained) <= least if self._pupils else not gained > least

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> int | None:
        """End the round when nothing is to be gained."""
        return -1 if self._stopped else None

    def training_step(self, batch: Any, batch_idx: int) -> None:
        """Make one iteration of the optimizer."""
        started = time.perf_counter()
        self._ended = None
        if self._left:
            self._between.append(started - self._left)
        optimizer = self.optimizers()
        bare = optimizer.optimizer
        if getattr(bare, "takes_residuals", False):
            progress = least_squares_iteration(bare, optimizer.step, self.merit)
        else:
            progress = gradient_iteration(bare, optimizer.step, self.merit, self.variables)
        self._stopped = progress.stopped
        if progress.value.operands:
            progress.value.operand_derivatives()  # the next Jacobian's, and logged
        done = time.perf_counter()
        self._record(progress, done - started)
        # What lies between two iterations is the training loop's, and the loggers'.
        self._left = done

    def on_train_epoch_end(self) -> None:
        """Choose the rays that pass the lens now, and decide whether to go on."""
        before = float(self.best_merit)
        self.merit().write_to(self.lens)
        try:
            self.merit = self._build(self.lens)
            value = self.merit()
            self._refuse_lost_light()
            reached = value.sum_of_squares()
            self._keep_if_better(value)
        except InputError as problem:
            # The best lens is kept; say why this one is not.
            logger.warning("Round %d ends with a lens that fails: %s", self.current_epoch, problem)
            reached = math.inf
        self.log("val/merit", reached)
        logger.info(
            "Round %d, %d iterations in all: %s; merit over the rays that pass now %.6g",
            self.current_epoch,
            len(self.history),
            self._stopped or "no end within the round",
            reached,
        )
        with torch.no_grad():
            self.round_start.copy_(self.variables.scaled)
            self.round_start_focus.copy_(foci(self.lens, self._focus_names))
        optimizer = self.optimizers().optimizer
        self._ended = before, reached
        if self._is_last(before, reached):
            self.trainer.should_stop = True
        elif hasattr(optimizer, "restart"):
            optimizer.restart()
        self._stopped, self._left = None, 0.0

    def on_fit_end(self) -> None:
        """Put the variables back to the best round."""
        self._fit_seconds = time.perf_counter() - self._fit_started
        self._leave_best()

    def on_test_start(self) -> None:
        """Put the variables to the best round of a checkpoint, if nothing was trained."""
        if not self._fit_seconds:
            self.settle()

    def settle(self) -> None:
        """Put the variables to the best round, if there was one."""
        if math.isfinite(float(self.best_merit)):
            self._leave_best()

    def _leave_best(self) -> None:
        with torch.no_grad():
            self.variables.scaled.copy_(self.best)
            self.variables.write_to(self.lens)
            set_foci(self.lens, self._focus_names, self.best_focus)
        set_entrance_pupils(self.lens, self._pupils)
        if self.automatic_semi_diameters:
            fit_edges(self.lens, None if self._pupils else self.initial, self.merit_settings)

    def _build(self, lens: Lens) -> MeritFunction | StatesMerit:
        if self._pupils:
            # The rays of each round are those of its pupils.
            set_entrance_pupils(lens, self._pupils)
            if self.automatic_semi_diameters:
                fit_edges(lens, None, self.merit_settings)
        if self._pupils or not self.automatic_semi_diameters:
            return self.merit_settings.build(lens, self.variables)
        # The rays of the start serve every round.
        return self.merit or self.merit_settings.build(self.initial, self.variables)

    def _refuse_lost_light(self) -> None:
        for state, quality in self.merit.qualities.items():
            if not self.automatic_semi_diameters:
                refuse_lost_light(quality, self.initial_light[state])

    def _keep_if_better(self, value: MeritValue | StatesValue) -> None:
        merit = value.sum_of_squares()
        if merit < float(self.best_merit):
            with torch.no_grad():
                self.best_merit.fill_(merit)
                self.best.copy_(self.variables.scaled)
                found = value.foci()
                distances = [found[name] for name in self._focus_names]
                self.best_focus.copy_(
                    self.best_focus.new_tensor(distances).view_as(self.best_focus)
                )

    # ---------------------------------------------------------------- what is logged

    def lens_values(self) -> dict[str, Tensor]:
        """Return the variables, what follows from them, and the focus."""
        if self.merit is None:
            return {}
        foci = {name: torch.tensor(at) for name, at in self.merit().foci().items()}
        return {**self.variables(), **foci}

    @property
    def rays(self) -> int:
        """Return the number of rays of one evaluation of the merit."""
        qualities = {} if self.merit is None else self.merit.qualities
        return sum(len(quality.spots.weight) for quality in qualities.values())

    @property
    def rays_launched(self) -> int:
        """Return the number of rays that were launched to find those that pass."""
        qualities = {} if self.merit is None else self.merit.qualities
        return sum(quality.spots.launched for quality in qualities.values())

    def _record(self, progress: Progress, seconds: float) -> None:
        row = iteration_row(progress, self.merit, seconds)
        self.history.append(row)
        self.log("train/merit", row["train/merit"], prog_bar=True, logger=False)
        # Straight to the loggers: Lightning's own bookkeeping costs more than many an iteration.
        count = len(self.history)
        if count <= _LOGGED_FIRST or count % self.trainer.log_every_n_steps == 0:
            for entry in self.loggers:
                entry.log_metrics(row, step=self.global_step)

    # ---------------------------------------------------------------- evaluation

    def test_step(self, batch: Any, batch_idx: int) -> None:
        """Log RMS spot radii before and after the design, and those of the published one."""
        metrics = state_metrics if self.evaluation.states_of(self.lens) else spot_metrics
        self.log_dict(metrics(self.lens, self._others(), self.evaluation))

    def _others(self) -> dict[str, Lens]:
        """Return the lenses that the design is compared with, by their names in metrics."""
        published = {} if self.published is None else {"published": self.published}
        return {"initial": self.initial, **published}

    def summary(self) -> dict[str, float]:
        """Return the merit of the best round, and costs."""
        numbers = {"cost/iterations": float(len(self.history)), "cost/rays": float(self.rays)}
        numbers["cost/rays_launched"] = float(self.rays_launched)
        if math.isfinite(float(self.best_merit)):
            numbers["train/merit"] = float(self.best_merit)
        for name in ("iteration_s", "jacobian_s"):
            if self.history:
                numbers[f"cost/{name}"] = statistics.median(r[f"cost/{name}"] for r in self.history)
        if self.history:
            numbers["cost/step_s"] = numbers["cost/iteration_s"]
            numbers["cost/fit_s"] = self._fit_seconds
        if self._between:
            numbers["cost/trainer_s"] = statistics.median(self._between)
        return numbers

    def figures(self) -> Figures:
        """Return the layout, spots, ray fans, MTF, RMS curves and the history."""
        merit = self.merit_settings
        # Weights of operands have units of their own, and so has the sum.
        unit = _MERIT_UNITS.get(merit.quality, "") if isinstance(merit.quality, str) else ""
        unit = "" if merit.operands else unit
        if not self.evaluation.states_of(self.lens):
            return design_figures(
                self.lens,
                self.initial,
                self.evaluation,
                self.history,
                self.mtf_max_frequency,
                unit,
                self.initial_merit,
                self._others(),
            )
        found = state_figures(self.lens, self._others(), self.evaluation, self.mtf_max_frequency)
        return {**found, **history_figures(self.lens, self.history, self.initial_merit, unit)}

    # ---------------------------------------------------------------- checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the history of iterations, the first merit, and those about the last round."""
        return {
            "history": self.history,
            "initial_merit": self.initial_merit,
            "ended": self._ended and list(self._ended),
        }

    def load_checkpoint_state(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on with that history."""
        self.history = list(checkpoint.get("history", []))
        self.initial_merit = float(checkpoint.get("initial_merit", math.nan))
        before_and_reached = checkpoint.get("ended")
        self._ended = tuple(before_and_reached) if before_and_reached else None

    def identity(self) -> dict[str, Any]:
        """Return the experiment, the lens and the names of the variables."""
        return {**super().identity(), "variables": list(self.variables.names)}
