"""Training and evaluation of a camera."""

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import lightning
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.as_built import AsBuilt, manufacture_of
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.calibration import Miscalibration
from dolens.experiments.camera.calibration import check as check_miscalibrations
from dolens.experiments.camera.camera_figures import camera_figures
from dolens.experiments.camera.evaluation import (
    Evaluation,
    behind_line,
    check_size,
    gain_line,
    means_of,
    photographs_of_crops,
    without_loss,
)
from dolens.experiments.camera.lens_merit import CameraOperands
from dolens.experiments.camera.lens_optimizer import LensSteps, variable_numbers
from dolens.experiments.camera.made_lenses import (
    MadeLensScores,
    made_lens_scores,
    made_lenses_figure_of,
    restored_in_parts,
    training_images,
)
from dolens.experiments.camera.photograph_scores import PhotographScores
from dolens.experiments.camera.reconstruction import compile_network
from dolens.experiments.camera.training import (
    Adversary,
    Reconstruction,
    StepCosts,
    Training,
    check_sharing,
    parameter_groups,
    summary_numbers,
)
from dolens.experiments.camera.views.base import Imaging, Views
from dolens.experiments.camera.views.exposures import Exposures
from dolens.experiments.experiment import Figures
from dolens.optics.lens import Lens
from dolens.reconstruction import UntrainedRestoration, psnr_db
from dolens.reconstruction.processes import mean_over_processes, processes
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)

# Beside the scores.
_METRICS = (
    "train/loss",
    "train/psnr_db",
    "train/*",
    "test*/photographs",
    "test*/crops",
    "test*/gain_over_*",
    "error/test*",
    "variables/*",
    "operand/*",
    "lens_step/*",
    "lens_steps/*",
    "lens_first/*",
    "auto/*",
    "made/*",
    "error/made/*",
    "train/sensitivity",
    "network/pretrained",
    "loss/perceptual_available",
)


class CameraModule(Camera):
    """Trains a lens and the network that restores its images, end to end.

    A batch of textures is imaged in several ways (at depths, or at places of the field), read out,
    and one network restores all the images without being told which.  The loss reaches the network
    and the lens's variables.

    All random numbers are functions of the seed and the step, so that a resumed run repeats an
    uninterrupted one.

    Args:
        lens: the lens; its other parameters stay as they are.
        views: images the textures.
        reconstruction: restores the images, and judges what it restored.
        training: how the network and the lens's variables move.
        variables: settings of `DesignVariables`; empty or None trains the network alone.
        operands: what the lens must be besides, as of a merit function: Σ (weight·deviation)² is
            added to the loss.  Objects are at the views' `object_distance`; see `CameraOperands`.
            A step of the lens after which a chief ray does not reach the stop is taken back.
        miscalibrations: point spread functions that tests give the network besides; see
            `Evaluation`.
        tolerances: of the lens that is made, see `tolerances_from`; None: the lens as drawn.
        as_built: how lenses are made, and what is known of them.
        exposures: how the states of a lens share the exposure time; None: one exposure.

    Raises:
        InputError: a setting is out of range, or the network or the loss does not fit.
    """

    def __init__(
        self,
        lens: Lens,
        views: Imaging,
        reconstruction: Reconstruction,
        training: Training,
        variables: Mapping[str, Mapping[str, Any] | None] | None,
        operands: Sequence[Mapping[str, Any]],
        miscalibrations: Mapping[str, Miscalibration] | None,
        tolerances: Mapping[str, Any] | None = None,
        as_built: AsBuilt | None = None,
        exposures: Exposures | None = None,
    ) -> None:
        if exposures is not None:
            views = exposures.of(views, lens)
            if tolerances is not None:
                raise InputError("exposures: given; allowed with tolerances: null")
        super().__init__(
            lens,
            views,
            reconstruction.network,
            reconstruction.loss,
            variables or {},
            reconstruction.view_norm,
        )
        learned = len(self.variables) or any(p.requires_grad for p in self.network.parameters())
        # No gradient passes an untrained restorer to a lens either.
        self.trains = bool(learned) and not isinstance(self.network, UntrainedRestoration)
        self.optimizer, self.scheduler = training.optimizer, training.scheduler
        self.learning_rates = rates = training.learning_rates.of(self.network)
        discriminator, rate = reconstruction.discriminator, rates.discriminator or rates.network
        self.adversary = Adversary(discriminator, rate) if discriminator else None
        self.compiled = reconstruction.compiled
        self.costs = StepCosts()
        self.evaluation = Evaluation(miscalibrations)
        self.test_scores: dict[str, PhotographScores] = {}
        self.validation_scores: PhotographScores | None = None  # of the last one
        # The images and restored images of the last batch that was evaluated, for callbacks.
        self.seen: tuple[Views, Tensor] | None = None
        self._looked_in_epoch: int | None = None
        self._shown: dict[str, Tensor] = {}  # stage → its first crop, for figures
        # Not for Lightning's strategy to average: discriminators have an optimizer of their own.
        others = self.adversary.names() if self.adversary else []
        self._ddp_params_and_buffers_to_ignore = [f"adversary.{name}" for name in others]
        if not len(self.variables):
            self._ddp_params_and_buffers_to_ignore.append("variables.scaled")
        check_size(views.sensor.height, views.sensor.width)
        views.check(lens)
        self.lens_steps = LensSteps(
            self.lens,
            self.variables,
            CameraOperands(operands, lens, views.object_distance),
            views,
            getattr(self.optimizer, "lens_steps", None),
        )
        views.expose(self.lens)
        check_miscalibrations(self.evaluation.miscalibrations, lens, self.knows_places)
        self.manufacture = manufacture_of(as_built, tolerances, self.lens, views)
        if self.manufacture and self.manufacture.settings.desensitising and self.lens_steps.apart:
            raise InputError(
                "as_built.desensitising: allowed where least squares move the lens "
                "(optimizer.lens=dls): 0, as they do not know of it"
            )
        self.made_scores: MadeLensScores | None = None
        self.made_front: list[MadeLensScores] = []
        self._made_crops: list[Tensor] = []

    def check_trainer(self, trainer: lightning.Trainer) -> None:
        """Refuse what the data or the discriminators cannot share; see `Experiment.check_trainer`.

        Raises:
            InputError: the line names the setting.
        """
        check_sharing(trainer, self.adversary, self.manufacture)

    # ---------------------------------------------------------------- training

    def setup(self, stage: str) -> None:
        """Compile the network that is to be trained, where that is asked for.

        Raises:
            InputError: torch cannot compile on this machine.
        """
        if self.compiled and stage == "fit":
            compile_network(self.network, self.device)

    def configure_optimizers(self) -> Any:
        """Return one optimizer, with a group for the network and one for the lens's variables."""
        optimizer = self.optimizer(parameter_groups(self))
        if self.scheduler is None:
            return optimizer
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self.scheduler(optimizer), "interval": "step"},
        }

    def on_train_start(self) -> None:
        """Design the lens before the first step, where its optimizer begins so."""
        if self.global_step == 0:
            self.lens_steps.begin(self.network.needs_point_spread_function, self.view_norm)

    def on_train_epoch_start(self) -> None:
        """Let the renderer look at the lens as it is now.

        Lightning does not come here when it resumes within an epoch: what was found at its start is
        in the checkpoint.  Nor does it when it resumes behind an epoch's last step, where the next
        epoch's first step comes here instead.
        """
        self._looked_in_epoch = self.current_epoch
        self.variables.scaled.requires_grad_(True)  # a renderer may compare derivatives
        if self.trainer.is_global_zero:
            with named_stage("looking at the lens"):
                photographs = self._photographs()
                lens = self.lens.with_values(self.variables())
                self.views.prepare(lens, self.comparison(), photographs)
        if processes() > 1:  # plans are made by the clock too: what one process found serves all
            found = self.trainer.strategy.broadcast(self.views.state())
            if not self.trainer.is_global_zero:
                self.views.load_state(self.lens, found)

    def _photographs(self) -> Tensor | None:
        """Return photographs on which a renderer chooses its model, if the data have some."""
        found = getattr(self.trainer.datamodule, "most_detailed", None)
        return None if found is None else found()

    def on_train_batch_start(self, batch: Tensor, batch_idx: int) -> None:
        """Start the step's clock; let the lens stand still where its share of the steps is over."""
        if processes() == 1:  # elsewhere all parameters have derivatives in every step
            until = getattr(self.optimizer, "until", 1.0)
            moves = self.global_step < until * self.trainer.estimated_stepping_batches
            self.variables.scaled.requires_grad_(moves)
        if batch_idx == 0 and self._looked_in_epoch != self.current_epoch:
            self.on_train_epoch_start()
        self.costs.start()

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor | None:
        """Render, restore, compare; `batch` holds textures (B, 3, h, w) in linear light.

        Where the network is held and the lens stands still, nothing is to move: None.
        """
        with self.costs.making_images():
            values, share = self.variables(), self.share_of_step(len(batch), batch_idx)
            taken, functions = training_images(self, self.manufacture, values, batch, share)
        self.costs.watch_backward(taken.given)
        restored = restored_in_parts(self, taken, functions)
        truth = taken.truth.to(restored.dtype)
        terms = self.loss_over_views(restored, truth, shared=True)
        with self.exact():
            penalty, operands = self.lens_steps.penalty(values)
            if self.manufacture is not None and self.manufacture.settings.desensitising:
                sensitivity = self.manufacture.penalty(self.lens.with_values(values))
                self.log("train/sensitivity", sensitivity.detach().float())
                penalty = penalty + sensitivity.to(penalty)
        total = terms["total"]
        if not self.lens_steps.apart:
            total = total + penalty.to(restored.dtype)
        with torch.no_grad():
            psnr = psnr_db(restored.flatten(0, 1), truth.flatten(0, 1)).mean()
            psnr = mean_over_processes(psnr)
        self.log("train/loss", terms["total"], prog_bar=True)
        self.log("train/psnr_db", psnr, prog_bar=True)
        for name, value in terms.items():
            if name != "total":
                self.log(f"train/{name}", value)
        for label, value in operands.items():
            self.log(f"operand/{label}", value.float())
        if self.adversary is not None:
            term, numbers = self.adversary(truth.flatten(0, 1), restored.flatten(0, 1))
            self.log_dict({f"train/{name}": value for name, value in numbers.items()})
            total = total + term
        return total if total.requires_grad else None

    def optimizer_step(
        self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None
    ) -> None:
        """Step, and finish the step of the lens, so that a checkpoint of this step holds it all."""
        before = self.variables.scaled.detach().clone()
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        if len(self.variables):
            share = optimizer.param_groups[0]["lr"] / self.learning_rates.network
            # `global_step` counts this step only when this method is done.
            found = self.lens_steps.finish(optimizer, before, self.global_step + 1, share)
            self.log_dict({f"lens_step/{name}": value for name, value in found.items()})

    def on_after_backward(self) -> None:
        """Close the optics' share of the backward pass."""
        self.costs.end_backward()

    def on_train_batch_end(self, outputs: Any, batch: Tensor, batch_idx: int) -> None:
        """Log the costs, and the lens's variables."""
        self.log_dict(self.costs.end())
        waiting = getattr(self.trainer.datamodule, "waiting", None)
        if waiting is not None and waiting.batches:
            self.costs.data = waiting.mean()
            self.log("cost/data_s", waiting.latest)
        self.log("cost/rays", float(self.views.rays()))
        self.log_dict(variable_numbers(self.variables()))

    def lens_values(self) -> dict[str, Tensor]:
        """Return the variables, and what follows from them."""
        return self.variables()

    # ---------------------------------------------------------------- evaluation

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        """Measure on the validation photographs."""
        self._evaluate(batch, "val", batch_idx)

    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        """Measure on the test photographs."""
        self._evaluate(batch, "test", batch_idx)

    def _evaluate(self, batch: Tensor, stage: str, index: int) -> None:
        if index == 0:
            self._shown[stage] = batch[:1].clone()
        if stage == "test" and self.manufacture is not None:
            self._made_crops.append(batch.clone())
        number = self.evaluation_batch(stage, index)
        self.seen = self.evaluation.measure(self, batch, stage, number)

    def on_validation_epoch_end(self) -> None:
        """Log the means."""
        self._log_evaluations()

    def on_test_epoch_end(self) -> None:
        """Log the means, and judge the camera by lenses that are made."""
        self._log_evaluations()
        if self.manufacture is not None and self.manufacture.settings.tested:
            crops, self._made_crops = torch.cat(self._made_crops), []
            of = photographs_of_crops(self.trainer, "test", len(crops))
            with named_stage("lenses as built"):
                self.made_scores = made_lens_scores(self, self.manufacture, crops, of)
                self.made_front = [
                    made_lens_scores(self, self.manufacture.at_factor(factor), crops, of)
                    for factor in self.manufacture.settings.judged_factors
                ]
        if "test" in self.test_scores:
            logger.info("%s", gain_line(self.test_scores["test"]))
            behind = behind_line(self.test_scores["test"])
            if behind is not None:
                logger.warning("%s", behind)

    def _log_evaluations(self) -> None:
        found = self.evaluation.scores(self.trainer, self.views.labels())
        for stage, scores in found.items():
            for name, value in means_of(scores).items():
                headline = stage in ("val", "test") and name in ("loss", "psnr_db")
                self.log(f"{stage}/{name}", value, prog_bar=headline)
        self.test_scores.update({s: without_loss(v) for s, v in found.items() if "test" in s})
        if "val" in found:
            self.validation_scores = without_loss(found["val"])

    def summary(self) -> dict[str, float]:
        """Return the variables, intervals of scores, and costs."""
        return summary_numbers(self)

    def metric_names(self) -> list[str]:
        """Return the names of scores, and what others begin with."""
        return [*self.evaluation.names(self), *_METRICS]

    def figures(self) -> Figures:
        """Return the first test crop, point spread functions, and the layout."""
        found = camera_figures(self, self._shown, "test", self.test_scores.get("test"))
        if self.made_scores is None:
            return found
        return {**found, "made_lenses": partial(made_lenses_figure_of, self.made_scores)}

    def training_figures(self) -> Figures:
        """Return those of the lens; `ValidationPictures` has the images."""
        found = dict(camera_figures(self, self._shown, "val"))
        del found["images"]
        return found

    # ---------------------------------------------------------------- checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the states of the views, the lens's steps and the discriminators."""
        state: dict[str, Any] = {"dolens_views": self.views.state(), **self.lens_steps.state()}
        if self.adversary is not None:
            state["dolens_adversary"] = self.adversary.optimizer.state_dict()
        return state

    def load_checkpoint_state(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on from these states."""
        self.views.load_state(self.lens, checkpoint.get("dolens_views", {}))
        self.lens_steps.load_state(checkpoint)
        if self.adversary is not None:
            self.adversary.optimizer.load_state_dict(checkpoint["dolens_adversary"])
