"""The training losses of the camera experiments as functions of their lenses' parameters."""

from collections.abc import Iterator, Mapping

import torch
from hydra.utils import instantiate
from torch import Tensor

from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens
from dolens.optics.lens import Lens
from dolens.rendering.gradient_check import Loss
from scripts.composed import composed

_SMALL = (
    "lens_dtype=float64",
    "renderer=rays",
    "renderer.pupil_samples=16",
    "loss.perceptual=none",
    "discriminator=none",
)
_EXPERIMENTS = {
    "wavefront_coding": (*_SMALL, "renderer.sensor.height=48", "renderer.sensor.width=48"),
    "large_fov_doublet": (
        *_SMALL,
        "renderer.sensor.height=48",
        "renderer.sensor.width=48",
        "renderer.sensor.pixel_pitch=0.03",
        "network=field_pyramid",
        "network.weights=none",
    ),
}
_BATCH = 2


def training_losses() -> Iterator[tuple[str, Lens, Loss, list[str]]]:
    """Title, lens, loss, and the names of the experiment's own variables."""
    for name, overrides in _EXPERIMENTS.items():
        with composed([f"experiment={name}", *overrides]) as cfg:
            lens = build_lens(RunSettings.of(cfg))
            module = instantiate(cfg.module)(lens=lens).double()
        module.eval()  # no statistics that move from call to call
        yield f"{name}, its training loss", lens, _loss(module), list(module.variables.names)


def _loss(module: torch.nn.Module) -> Loss:
    sensor = module.views.sensor
    generator = torch.Generator().manual_seed(1)
    shape = (_BATCH, 3, sensor.height // 4 + 24, sensor.width // 4 + 24)
    coarse = torch.rand(shape, generator=generator, dtype=torch.float64)
    textures = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bicubic")

    def loss(values: Mapping[str, Tensor], seed: int) -> Tensor:
        every = {**{n: p.detach() for n, p in module.variables().items()}, **values}
        taken = module.views.take(module.lens, every, textures, "train", seed)
        functions = module.functions(every, taken, "train")
        restored = module.restore(taken, functions)
        terms = module.loss_over_views(restored, taken.truth.to(restored.dtype))
        return terms["total"]

    return loss
