"""A camera as one Lightning module: lens, scene, renderer, readout, reconstruction and loss."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.imaging.color import linear_to_srgb
from dolens.imaging.psf import axial_point_spread_functions
from dolens.imaging.readout import Readout
from dolens.imaging.renderer import Renderer
from dolens.imaging.scene import PlanarScene, pinhole_image
from dolens.optics.lens import Lens
from dolens.optimize.variables import DesignVariables
from dolens.reconstruction import (
    Restoration,
    RestorationLoss,
    psnr_db,
    structural_similarity,
)

# Streams of random numbers that must not meet: (what, stage) → an offset of the seed.
_STREAMS = {"train": 0, "val": 1, "test": 2}
_STREAM_STRIDE, _NOISE_OFFSET = 1 << 40, 1 << 39


class CameraModule(lightning.LightningModule):
    """End-to-end training of a camera on planar scenes at several depths.

    A batch of textures is imaged at every depth and read out, and one network restores all the
    images without being told the depth.  The loss reaches the network and the lens's variables.

    All random numbers are functions of the seed and the step, so that a resumed run repeats an
    uninterrupted one.

    Args:
        lens: the lens; its other parameters stay as they are.
        experiment: name of the experiment; a checkpoint of another one is refused.
        scene: depths and wavelengths.
        renderer: makes the training images.
        readout: what the sensor makes of them.
        network: restores them.
        loss: compares display-encoded images.
        optimizer: parameter groups → optimizer.
        learning_rates: `optics` and `network`.
        scheduler: optimizer → scheduler, stepped once a training step; or None.
        variables: settings of `DesignVariables`; empty or None trains the network alone.
        evaluation_renderer: makes the validation and test images, of the same sensor; by default
            the training renderer, which then judges its own approximations.
        depth_norm: p of the power mean that joins the depths' losses; see `loss_over_depths`.
        psf_size: pixels along each side of the point spread functions.
        psf_pupil_samples: their strata along each side of the pupil.
        seed: of rendering and noise.
    """

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        scene: PlanarScene,
        renderer: Renderer,
        readout: Readout,
        network: Restoration,
        loss: RestorationLoss,
        optimizer: Callable[..., torch.optim.Optimizer],
        learning_rates: Mapping[str, float],
        scheduler: Callable[..., Any] | None = None,
        variables: Mapping[str, Mapping[str, Any] | None] | None = None,
        evaluation_renderer: Renderer | None = None,
        depth_norm: float = 1.0,
        psf_size: int = 65,
        psf_pupil_samples: int = 48,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.lens = lens.requires_grad_(False)
        self.variables = DesignVariables(lens, variables or {})
        self.variables.write_to(self.lens)
        self.network = network
        self.loss = loss
        self.experiment = experiment
        self.scene = scene
        self.renderer = renderer
        self.evaluation_renderer = evaluation_renderer or renderer
        if self.evaluation_renderer.sensor != renderer.sensor:
            raise InputError(
                f"evaluation_renderer.sensor: {self.evaluation_renderer.sensor} is not that of "
                f"the training renderer, {renderer.sensor}"
            )
        self.optimizer = optimizer
        self.scheduler = scheduler
        self.learning_rates = dict(learning_rates)
        self.readout = readout
        if not depth_norm >= 1.0:
            raise InputError(f"depth_norm must be at least 1, not {depth_norm}")
        self.depth_norm = depth_norm
        self.psf_size = psf_size
        self.psf_pupil_samples = psf_pupil_samples
        self.seed = seed
        self.step_seconds: list[float] = []
        self.optics_seconds: list[float] = []
        self._evaluations: list[dict[str, Tensor]] = []
        self._step_started = self._optics_started = 0.0
        scene.check(lens.system())
        missing = {"optics", "network"} - set(self.learning_rates)
        if missing:
            raise InputError(f"learning_rates: '{missing.pop()}' is missing (optics and network)")

    # ---------------------------------------------------------------- imaging and restoration

    def truth(self, textures: Tensor) -> Tensor:
        """(B, 3, H, W), display-encoded: what a distortion-free pinhole sees."""
        return linear_to_srgb(pinhole_image(textures, self.renderer.sensor))

    def raw_images(
        self, textures: Tensor, renderer: Renderer, seed: int, values: Mapping[str, Tensor]
    ) -> Tensor:
        """(B, depths, 3, H, W), linear light, read out and developed."""
        image = renderer.render(self.lens, self.scene, textures, seed, values)
        generator = torch.Generator(image.device).manual_seed(seed + _NOISE_OFFSET)
        return self.readout.develop(self.readout(image, generator))

    def point_spread_functions(self, values: Mapping[str, Tensor]) -> Tensor | None:
        """(depths, 3, K, K) of the lens as it is, or None where the network asks for none."""
        if not self.network.needs_point_spread_function:
            return None
        return axial_point_spread_functions(
            self.lens,
            self.scene,
            self.renderer.sensor,
            self.psf_size,
            self.psf_pupil_samples,
            values,
        )

    def restore(self, raw: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        """(B, depths, 3, H, W), display-encoded, of raw images of that shape."""
        restored = self.network(raw.flatten(0, 1), self.point_spread_functions(values))
        return restored.unflatten(0, raw.shape[:2])

    def loss_over_depths(self, restored: Tensor, truth: Tensor) -> dict[str, Tensor]:
        """The loss and its terms, of images (B, depths, 3, H, W).

        Terms are means over the depths.  The total is the power mean (Σ L_d^p / D)^(1/p) of the
        depths' totals with p = `depth_norm`: at p = 1 their mean, and the larger p is, the more
        the worst depth counts, which is what an extended depth of field is for.
        """
        rows = [self.loss(restored[:, d], truth[:, d]) for d in range(restored.shape[1])]
        terms = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        largest = terms["total"].detach().amax().clamp(min=torch.finfo(restored.dtype).tiny)
        relative = (terms["total"] / largest) ** self.depth_norm
        total = largest * relative.mean() ** (1.0 / self.depth_norm)
        return {name: value.mean() for name, value in terms.items()} | {"total": total}

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
        if len(self.variables):
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
        """Let the renderer look at the lens as it is now; not when an epoch is resumed within."""
        if self.trainer.fit_loop.epoch_loop.batch_progress.current.ready == 0:
            self.renderer.prepare(self.lens, self.scene, self.variables())

    def on_train_batch_start(self, batch: Tensor, batch_idx: int) -> None:
        """Start the step's clock."""
        self._step_started = time.perf_counter()

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        """Render, restore, compare; `batch` holds textures (B, 3, h, w) in linear light."""
        started = time.perf_counter()
        values = self.variables()
        raw = self.raw_images(batch, self.renderer, self._seed("train", self.global_step), values)
        self.optics_seconds.append(time.perf_counter() - started)
        if raw.requires_grad:
            # The image's gradient is the network's last; what comes after it is the lens's.
            raw.register_hook(self._start_optics_backward)
        restored = self.restore(raw, values)
        truth = self.truth(batch)[:, None].expand_as(restored)
        terms = self.loss_over_depths(restored, truth.to(restored.dtype))
        with torch.no_grad():
            psnr = psnr_db(restored.flatten(0, 1), truth.flatten(0, 1)).mean()
        self.log("train/loss", terms["total"], prog_bar=True)
        self.log("train/psnr_db", psnr, prog_bar=True)
        for name, value in terms.items():
            if name != "total":
                self.log(f"train/{name}", value)
        return terms["total"]

    def on_after_backward(self) -> None:
        """Close the optics' share of the backward pass."""
        if self._optics_started:
            self.optics_seconds[-1] += time.perf_counter() - self._optics_started
            self._optics_started = 0.0

    def on_train_batch_end(self, outputs: Any, batch: Tensor, batch_idx: int) -> None:
        """Project the variables onto their bounds (S17), store them in the lens, log the cost."""
        if len(self.variables):
            self.variables.project()
            self.variables.write_to(self.lens)
        self.step_seconds.append(time.perf_counter() - self._step_started)
        self.log("cost/step_s", self.step_seconds[-1])
        self.log("cost/optics_s", self.optics_seconds[-1])
        self.log("cost/network_s", self.step_seconds[-1] - self.optics_seconds[-1])
        self.log("cost/rays", float(self.renderer.rays_per_image(self.scene)))
        with torch.no_grad():
            for name, value in self._variable_numbers().items():
                self.log(f"variables/{name}", value)

    def _start_optics_backward(self, gradient: Tensor) -> None:
        self._optics_started = time.perf_counter()

    def _seed(self, stage: str, index: int) -> int:
        return (self.seed * len(_STREAMS) + _STREAMS[stage]) * _STREAM_STRIDE + index

    # ---------------------------------------------------------------- evaluation

    def evaluation_images(
        self, batch: Tensor, stage: str, index: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Truth (B, 3, H, W), raw and restored (B, depths, 3, H, W), display-encoded.

        The same stage and index give the same images of the same camera.
        """
        with torch.no_grad():
            values = self.variables()
            raw = self.raw_images(batch, self.evaluation_renderer, self._seed(stage, index), values)
            restored = self.restore(raw, values)
            return self.truth(batch), linear_to_srgb(raw), restored.clamp(0.0, 1.0)

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        """Measure on the validation photographs."""
        self._evaluate(batch, "val", batch_idx)

    def test_step(self, batch: Tensor, batch_idx: int) -> None:
        """Measure on the test photographs."""
        self._evaluate(batch, "test", batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Log the means."""
        self._log_evaluations("val")

    def on_test_epoch_end(self) -> None:
        """Log the means."""
        self._log_evaluations("test")

    def _evaluate(self, batch: Tensor, stage: str, index: int) -> None:
        truth, raw, restored = self.evaluation_images(batch, stage, index)
        loss = self.loss_over_depths(
            restored, truth[:, None].expand_as(restored).to(restored.dtype)
        )
        row = {"loss": loss["total"].expand(len(batch), len(self.scene.depths))}
        for name, image in (("", restored), ("raw_", raw)):
            row[f"{name}psnr_db"] = torch.stack(
                [psnr_db(image[:, d], truth) for d in range(image.shape[1])], 1
            )
            row[f"{name}ssim"] = torch.stack(
                [structural_similarity(image[:, d], truth) for d in range(image.shape[1])], 1
            )
        self._evaluations.append(row)

    def _log_evaluations(self, stage: str) -> None:
        rows, self._evaluations = self._evaluations, []
        if not rows:
            return
        for name in rows[0]:
            by_depth = torch.cat([row[name] for row in rows]).mean(dim=0).float()
            headline = name in ("loss", "psnr_db")
            self.log(f"{stage}/{name}", by_depth.mean(), prog_bar=headline)
            if name != "loss":
                for label, value in zip(self.scene.labels(), by_depth, strict=True):
                    self.log(f"{stage}/{name}/{label}", value)
                self.log(f"{stage}/{name}/worst", by_depth.min())

    def summary(self) -> dict[str, float]:
        """Numbers about the whole run, for metrics.json."""
        numbers = {f"variables/{n}": float(v) for n, v in self._variable_numbers().items()}
        numbers["loss/perceptual_available"] = float(self.loss.perceptual_available)
        numbers["cost/rays"] = float(self.renderer.rays_per_image(self.scene))
        numbers |= self.renderer.numbers()
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

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say whose checkpoint it is, in plain values."""
        checkpoint["dolens"] = self._identity()
        checkpoint["dolens_renderer"] = self.renderer.state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another experiment before any weight is loaded."""
        found, own = checkpoint.get("dolens"), self._identity()
        if not isinstance(found, dict):
            raise InputError("ckpt_path: this file is no checkpoint of a dolens camera")
        for key, value in own.items():
            if found.get(key) != value:
                raise InputError(
                    f"ckpt_path: the checkpoint's {key} is {found.get(key)!r}, this run's is "
                    f"{value!r}; resume with the experiment and settings that wrote it"
                )
        self.renderer.load_state(self.lens, checkpoint.get("dolens_renderer", {}))

    def _identity(self) -> dict[str, Any]:
        return {
            "experiment": self.experiment,
            "lens": self.lens.name,
            "variables": list(self.variables.names),
            "network": ", ".join(f"{n} {tuple(p.shape)}" for n, p in _shapes(self.network)),
        }


def _shapes(module: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """The first and last parameters: enough to tell networks of other widths or kinds apart."""
    parameters = list(module.named_parameters())
    return iter([parameters[0], parameters[-1]]) if parameters else iter([])
