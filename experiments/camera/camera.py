"""A camera as one Lightning module: a lens, how it looks, reconstruction and loss."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optimize.variables import DesignVariables
from dolens.reconstruction import (
    RelativisticDiscriminators,
    Restoration,
    RestorationLoss,
    psnr_db,
)
from dolens.sensor.colour import linear_to_srgb
from experiments.camera.adversary import Adversary
from experiments.camera.calibration import Calibration
from experiments.camera.calibration import check as check_calibrations
from experiments.camera.evaluation import Evaluation, means_of, without_loss
from experiments.camera.lens_least_squares import LensLeastSquares
from experiments.camera.operands import CameraOperands
from experiments.camera.photograph_scores import PhotographScores
from experiments.camera.views.base import Comparison, Imaging, Views
from experiments.experiment import Experiment


class CameraModule(Experiment):
    """End-to-end training of a camera.

    A batch of textures is imaged in several ways (at depths, or at places of the field), read out,
    and one network restores all the images without being told which.  The loss reaches the network
    and the lens's variables.

    All random numbers are functions of the seed and the step, so that a resumed run repeats an
    uninterrupted one.

    Args:
        lens: the lens; its other parameters stay as they are.
        experiment: name of the experiment; a checkpoint of another one is refused.
        views: images the textures.
        network: restores them.
        loss: compares display-encoded images.
        optimizer: parameter groups → optimizer; a `CameraOptimizer` may move the lens apart.
        learning_rates: `optics` and `network`.
        scheduler: optimizer → scheduler, stepped once a training step; or None.
        variables: settings of `DesignVariables`; empty or None trains the network alone.
        discriminator: judges the restored images besides; None for no adversarial term.
        operands: what the lens must be besides, as of a merit function: Σ (weight·deviation)² is
            added to the loss.  Objects are at the views' `object_distance`; see `CameraOperands`.
            A step of the lens after which a chief ray does not reach the stop is taken back.
        view_norm: p of the power mean that joins the views' losses; see `loss_over_views`.
        calibrations: point spread functions that tests give the network besides; see `Evaluation`.
    """

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        views: Imaging,
        network: Restoration,
        loss: RestorationLoss,
        optimizer: Callable[..., torch.optim.Optimizer],
        learning_rates: Mapping[str, float],
        scheduler: Callable[..., Any] | None = None,
        variables: Mapping[str, Mapping[str, Any] | None] | None = None,
        discriminator: RelativisticDiscriminators | None = None,
        operands: Sequence[Mapping[str, Any]] = (),
        view_norm: float = 1.0,
        calibrations: Mapping[str, Calibration] | None = None,
    ) -> None:
        super().__init__(lens, experiment)
        self.variables = DesignVariables(lens, variables or {})
        self.variables.write_to(self.lens)
        self.operands = CameraOperands(operands, lens, views.object_distance)
        self.network = network
        self.loss = loss
        self.adversary = Adversary(discriminator, learning_rates) if discriminator else None
        self.views = views
        self.optimizer = optimizer
        self.lens_steps: LensLeastSquares | None = getattr(optimizer, "lens_steps", None)
        self.scheduler = scheduler
        self.learning_rates = dict(learning_rates)
        if not view_norm >= 1.0:
            raise InputError(f"view_norm must be at least 1, not {view_norm}")
        self.view_norm = view_norm
        self.step_seconds: list[float] = []
        self.optics_seconds: list[float] = []
        self.evaluation = Evaluation(calibrations)
        self.test_scores: dict[str, PhotographScores] = {}
        self._step_started = self._optics_started = 0.0
        self._looked_in_epoch: int | None = None
        # Of the lens as it begins, so that a resumed run measures steps as an uninterrupted one.
        views.check(lens)
        steps = self.lens_steps if len(self.variables) else None
        self._spots = views.spots(self.lens, steps.rings, steps.arms) if steps else []
        self.operands.check(lens, self.variables())
        views.expose(self.lens)
        check_calibrations(self.evaluation.calibrations, lens)
        missing = {"optics", "network"} - set(self.learning_rates)
        if missing:
            raise InputError(f"learning_rates: '{missing.pop()}' is missing (optics and network)")

    # ---------------------------------------------------------------- restoration and loss

    def restore(self, taken: Views, functions: Tensor | None) -> Tensor:
        """(B, V, 3, H, W), display-encoded.

        Args:
            taken: what the sensor gave.
            functions: point spread functions, or None where the network asks for none.
        """
        field = None if taken.field is None else taken.field.flatten(0, 1)
        restored = self.network(taken.raw.flatten(0, 1), functions, field)
        return restored.unflatten(0, taken.raw.shape[:2])

    def loss_over_views(self, restored: Tensor, truth: Tensor) -> dict[str, Tensor]:
        """The loss and its terms, of images (B, V, 3, H, W).

        Terms are means over the views.  The total is the power mean (Σ L_v^p / V)^(1/p) of the
        views' totals with p = `view_norm`: at p = 1 their mean, and the larger p is, the more the
        worst one counts, which is what an extended depth of field is for.
        """
        rows = [self.loss(restored[:, v], truth[:, v]) for v in range(restored.shape[1])]
        terms = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        largest = terms["total"].detach().amax().clamp(min=torch.finfo(restored.dtype).tiny)
        relative = (terms["total"] / largest) ** self.view_norm
        total = largest * relative.mean() ** (1.0 / self.view_norm)
        return {name: value.mean() for name, value in terms.items()} | {"total": total}

    def penalty(self, values: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """What the operands add to the loss, and their values by label."""
        return self.operands.penalty(self.lens, values)

    def take(
        self,
        values: Mapping[str, Tensor],
        batch: Tensor,
        stage: str,
        index: int,
        judge: str | None = None,
    ) -> tuple[Views, Tensor | None]:
        """Images of textures, and point spread functions where the network asks for them.

        In the lens's own precision, whatever the trainer's: lenses need all digits.
        """
        with torch.autocast(self.device.type, enabled=False):
            taken = self.views.take(self.lens, values, batch, stage, index, judge)
            return taken, self.functions(values)

    def functions(self, values: Mapping[str, Tensor]) -> Tensor | None:
        """Point spread functions of the lens as it is, where the network asks for them."""
        if not self.network.needs_point_spread_function:
            return None
        return self.views.point_spread_functions(self.lens, values)

    # ---------------------------------------------------------------- training

    def configure_optimizers(self) -> Any:
        """One optimizer; the lens's variables and the network have learning rates of their own."""
        groups = [
            {
                "params": list(self.network.parameters()),
                "lr": self.learning_rates["network"],
                "name": "network",
            }
        ]
        if len(self.variables) and self.lens_steps is None:
            groups.append(
                {
                    "params": [self.variables.scaled],
                    "lr": self.learning_rates["optics"],
                    "name": "optics",
                }
            )
        optimizer = self.optimizer(groups)
        if self.scheduler is None:
            return optimizer
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self.scheduler(optimizer), "interval": "step"},
        }

    def on_train_epoch_start(self) -> None:
        """Let the renderer look at the lens as it is now.

        Lightning does not come here when it resumes within an epoch: what was found at its start is
        in the checkpoint.  Nor does it when it resumes behind an epoch's last step, where the next
        epoch's first step comes here instead.
        """
        self._looked_in_epoch = self.current_epoch
        self.views.prepare(self.lens, self.variables(), self._comparison(), self._photographs())

    def _photographs(self) -> Tensor | None:
        """What a renderer that chooses its model is tried on besides its own images, where the data
        have some.
        """
        found = getattr(self.trainer.datamodule, "most_detailed", None)
        return None if found is None else found()

    def _comparison(self) -> Comparison | None:
        """What the renderer's gradients are for; None where the lens is not varied."""
        if not len(self.variables):
            return None

        def loss(taken: Views, values: Mapping[str, Tensor]) -> Tensor:
            functions = self.functions(values)
            # No statistics or dropout of its own may move while gradients are compared.
            training = self.network.training
            self.network.eval()
            restored = self.restore(taken, functions)
            self.network.train(training)
            return self.loss_over_views(restored, taken.truth.to(restored.dtype))["total"]

        return Comparison([self.variables.scaled], self.variables, loss)

    def on_train_batch_start(self, batch: Tensor, batch_idx: int) -> None:
        """Start the step's clock."""
        if batch_idx == 0 and self._looked_in_epoch != self.current_epoch:
            self.on_train_epoch_start()
        self._step_started = time.perf_counter()

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        """Render, restore, compare; `batch` holds textures (B, 3, h, w) in linear light."""
        started = time.perf_counter()
        values = self.variables()
        taken, functions = self.take(values, batch, "train", self.global_step)
        self.optics_seconds.append(time.perf_counter() - started)
        if taken.raw.requires_grad:
            # The image's gradient is the network's last; what comes after it is the lens's.
            taken.raw.register_hook(self._start_optics_backward)
        restored = self.restore(taken, functions)
        truth = taken.truth.to(restored.dtype)
        terms = self.loss_over_views(restored, truth)
        penalty, operands = self.penalty(values)
        total = terms["total"]
        if self.lens_steps is None:
            # Steps of least squares know the operands themselves.
            total = total + penalty.to(restored.dtype)
        with torch.no_grad():
            psnr = psnr_db(restored.flatten(0, 1), truth.flatten(0, 1)).mean()
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
        return total

    def optimizer_step(
        self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None
    ) -> None:
        """Step; move the lens, if that is done apart; project its variables onto their bounds (S17)
        and store them in it.  A checkpoint of this step has it all.
        """
        before = self.variables.scaled.detach().clone()
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        # `global_step` counts this step only when this method is done.
        if not len(self.variables):
            return
        if self.lens_steps is not None:
            self.lens_steps.gather(self.variables)
            if self.lens_steps.is_due(self.global_step + 1):
                pitch, group = self.views.sensor.pixel_pitch, optimizer.param_groups[0]
                share = group["lr"] / self.learning_rates["network"]
                found = self.lens_steps.step(
                    self.lens,
                    self.variables,
                    self._spots,
                    pitch,
                    self.operands.entries,
                    share,
                    self.operands.object_distance,
                )
                self.log_dict({f"lens_step/{name}": value for name, value in found.items()})
        self.variables.project()
        self.operands.take_back_if_unreachable(
            self.lens, self.variables, before, lambda: self._forget_last_step(optimizer)
        )
        self.variables.write_to(self.lens)

    def _forget_last_step(self, optimizer: Any) -> None:
        """Drop what led to the lens's last step: Adam's momentum, least squares' reach."""
        optimizer.state.pop(self.variables.scaled, None)
        if self.lens_steps is not None:
            self.lens_steps.reject()

    def on_after_backward(self) -> None:
        """Close the optics' share of the backward pass."""
        if self._optics_started:
            self.optics_seconds[-1] += time.perf_counter() - self._optics_started
            self._optics_started = 0.0

    def on_train_batch_end(self, outputs: Any, batch: Tensor, batch_idx: int) -> None:
        """Log the cost."""
        self.step_seconds.append(time.perf_counter() - self._step_started)
        self.log("cost/step_s", self.step_seconds[-1])
        self.log("cost/optics_s", self.optics_seconds[-1])
        self.log("cost/network_s", self.step_seconds[-1] - self.optics_seconds[-1])
        self.log("cost/rays", float(self.views.rays()))
        with torch.no_grad():
            for name, value in self._variable_numbers().items():
                self.log(f"variables/{name}", value)

    def _start_optics_backward(self, gradient: Tensor) -> None:
        self._optics_started = time.perf_counter()

    # ---------------------------------------------------------------- evaluation

    def evaluation_images(
        self, batch: Tensor, stage: str, index: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Truth, raw and restored (B, V, 3, H, W), display-encoded.

        The same stage and index give the same images of the same camera.
        """
        with torch.no_grad():
            values = self.variables()
            taken, functions = self.take(values, batch, stage, index)
            restored = self.restore(taken, functions)
            return taken.truth, linear_to_srgb(taken.raw), restored.clamp(0.0, 1.0)

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        """Measure on the validation photographs."""
        self.evaluation.measure(self, batch, "val", batch_idx)

    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        """Measure on the test photographs."""
        self.evaluation.measure(self, batch, "test", batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Log the means."""
        self._log_evaluations()

    def on_test_epoch_end(self) -> None:
        """Log the means."""
        self._log_evaluations()

    def _log_evaluations(self) -> None:
        found = self.evaluation.scores(self.trainer, self.views.labels())
        for stage, scores in found.items():
            for name, value in means_of(scores).items():
                headline = stage in ("val", "test") and name in ("loss", "psnr_db")
                self.log(f"{stage}/{name}", value, prog_bar=headline)
        self.test_scores.update({s: without_loss(v) for s, v in found.items() if "test" in s})

    def summary(self) -> dict[str, float]:
        """Numbers about the whole run, for metrics.json."""
        numbers = {f"variables/{n}": float(v) for n, v in self._variable_numbers().items()}
        for stage, scores in self.test_scores.items():
            numbers |= scores.numbers(stage)
        if isinstance(getattr(self.network, "pretrained", None), bool):
            numbers["network/pretrained"] = float(self.network.pretrained)
        if hasattr(self.loss, "perceptual_available"):  # a loss of a user's own may know no such
            numbers["loss/perceptual_available"] = float(self.loss.perceptual_available)
        numbers["cost/rays"] = float(self.views.rays())
        numbers |= self.views.numbers() | self.evaluation.costs()
        if self.operands.entries:
            numbers["lens_steps/taken_back"] = float(self.operands.taken_back)
        if self.lens_steps is not None:
            numbers |= self.lens_steps.numbers()
        if self.step_seconds:
            numbers["cost/step_s"] = statistics.median(self.step_seconds)
            numbers["cost/optics_s"] = statistics.median(self.optics_seconds)
            numbers["cost/network_s"] = numbers["cost/step_s"] - numbers["cost/optics_s"]
        return numbers

    @torch.no_grad()
    def _variable_numbers(self) -> dict[str, Tensor]:
        """The variables as metrics: a number as it is, an array by its root mean square."""
        numbers = {}
        for name, value in self.variables().items():
            if value.dim() == 0:
                numbers[name] = value.float()
            else:
                numbers[f"{name}/rms"] = value.float().square().mean().sqrt()
        return numbers

    # ---------------------------------------------------------------- checkpoints

    def checkpoint_state(self) -> dict[str, Any]:
        """Return what the views, the lens's optimizer and the discriminators go on from."""
        state: dict[str, Any] = {"dolens_views": self.views.state()}
        if self.lens_steps is not None:
            state["dolens_lens_steps"] = self.lens_steps.state()
        if self.adversary is not None:
            state["dolens_adversary"] = self.adversary.optimizer.state_dict()
        return state

    def load_checkpoint_state(self, checkpoint: Mapping[str, Any]) -> None:
        """Take it up."""
        self.views.load_state(self.lens, checkpoint.get("dolens_views", {}))
        if self.lens_steps is not None and "dolens_lens_steps" in checkpoint:
            self.lens_steps.load_state(checkpoint["dolens_lens_steps"])
        if self.adversary is not None:
            self.adversary.optimizer.load_state_dict(checkpoint["dolens_adversary"])

    def identity(self) -> dict[str, Any]:
        """Return the experiment, the lens, the variables' names and the network's shapes."""
        return {
            **super().identity(),
            "variables": list(self.variables.names),
            "network": ", ".join(f"{n} {tuple(p.shape)}" for n, p in _shapes(self.network)),
        }


def _shapes(module: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """The first and last parameters: enough to tell networks of other widths or kinds apart."""
    parameters = list(module.named_parameters())
    return iter([parameters[0], parameters[-1]]) if parameters else iter([])
