"""Derivatives of images by autograd beside differences, as a table.

    python scripts/gradients.py                       # all lenses, by rays: tens of minutes
    python scripts/gradients.py --lens cooke_near --renderer psf --rays 20
    python scripts/gradients.py --experiment          # the experiments' own training losses

Each row is the derivative of a loss with respect to one parameter, in units of its scale, by
autograd and by central differences of the same loss with the same random samples, and the standard
error of their difference over the seeds.
"""

import argparse
import math
import statistics
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.experiments.camera.views.base import Shot
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_module
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription, load_prescription
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.probes import probe_texture
from dolens.rendering.gradient_check import GradientRow, Loss, gradient_rows
from dolens.rendering.protocol import Renderer
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor
from scripts.composed import CONF, composed

LINES = (656.2725, 587.5618, 486.1327)
RENDERERS = ("rays", "rays_reference", "psf", "wave", "auto")
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


@dataclass(frozen=True)
class Case:
    """A lens in front of a plane.

    Attributes:
        file: of the lens, in conf/lens.
        depth: mm.
        diagonal: of the sensor, mm; pixels divide it.
        pitch: of the pixels instead, mm.
        values: parameters to change first.
        elements: of the prescription.
    """

    file: str
    depth: float
    diagonal: float | None = None
    pitch: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    elements: Mapping[str, Any] = field(default_factory=dict)

    def lens(self) -> Lens:
        """The lens, in double precision."""
        prescription = load_prescription(CONF / "lens" / f"{self.file}.yaml")
        if self.elements:
            prescription = prescription | {"elements": dict(self.elements)}
        lens = lens_from_prescription(prescription, torch.float64, where=self.file)
        with torch.no_grad():
            for name, value in self.values.items():
                dict(lens.named_parameters())[name].fill_(value)
        return lens

    def sensor(self, pixels: int) -> Sensor:
        """A square of pixels."""
        pitch = self.pitch or self.diagonal / math.sqrt(2.0) / pixels
        return Sensor(pixels, pixels, pitch)


_POSE = {"middle": {"surfaces": [3, 4], "tilt_x": 0.8, "tilt_y": -0.4, "decenter_y": 0.06}}
CASES = {
    "wavefront_coding": Case(
        "wavefront_coding",
        8000.0,
        pitch=0.0069,
        values={"surfaces.5.x3": 1.5e-5, "surfaces.5.x2y": 3e-6, "surfaces.5.y3": 1.2e-5},
    ),
    "cooke_near": Case("cooke_triplet", 1000.0, diagonal=36.346),
    "cooke_far": Case("cooke_triplet", 1e6, diagonal=36.346),
    "doublet": Case("large_fov_doublet", 1e6, diagonal=48.437),
    "nikon": Case("nikon", 1e4, diagonal=1.912),
    "double_gauss": Case("double_gauss", 1e5, diagonal=80.8),
    "posed": Case("cooke_triplet", 1000.0, diagonal=30.0, elements=_POSE),
}


def names_of(lens: Lens) -> list[str]:
    """Every curvature, gap, coefficient and pose, the sensor, and the stop's semi-diameter."""
    scalars = [n for n, p in lens.named_parameters() if p.dim() == 0]
    return [*scalars, f"surfaces.{lens.stop}.semi_diameter"]


def renderer_of(kind: str, sensor: Sensor, samples: int) -> Renderer:
    """A renderer by name."""
    if kind.startswith("rays"):
        return RayRenderer(sensor, samples)
    if kind == "auto":
        return AutoRenderer(sensor, gradients=True)
    wave = "wave" if kind == "wave" else "none"
    size = min(65, 2 * (sensor.height // 2) + 9)
    return PsfRenderer(sensor, (5, 5), samples, size, diffraction=wave)


def image_loss(case: Case, lens: Lens, kind: str, pixels: int, samples: int) -> Loss:
    """Mean squared error between an image and what a pinhole sees."""
    sensor = case.sensor(pixels)
    scene, texture = PlanarScene((case.depth,), LINES), probe_texture(sensor, 3, 0)
    truth = pinhole_image(texture, sensor)[:, None]
    renderer = renderer_of(kind, sensor, samples)
    lens.backend = "reference" if kind == "rays_reference" else "auto"

    def loss(values: Mapping[str, Tensor], seed: int) -> Tensor:
        image = renderer.render(lens.with_values(values), scene, texture, seed)
        return (image - truth).square().mean()

    return loss


def training_losses() -> Iterator[tuple[str, Lens, Loss, list[str]]]:
    """Title, lens, loss, and the names of the experiment's own variables."""
    for name, overrides in _EXPERIMENTS.items():
        with composed([f"experiment={name}", *overrides]) as cfg:
            module: Any = build_module(RunSettings.of(cfg)).double()
        module.eval()  # no statistics that move from call to call
        yield f"{name}, its training loss", module.lens, _loss(module), list(module.variables.names)


def _loss(module: torch.nn.Module) -> Loss:
    sensor = module.views.sensor
    generator = torch.Generator().manual_seed(1)
    shape = (_BATCH, 3, sensor.height // 4 + 24, sensor.width // 4 + 24)
    coarse = torch.rand(shape, generator=generator, dtype=torch.float64)
    textures = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bicubic")

    def loss(values: Mapping[str, Tensor], seed: int) -> Tensor:
        every = {**{n: p.detach() for n, p in module.variables().items()}, **values}
        taken = module.views.take(module.lens.with_values(every), Shot(textures, "train", seed))
        functions = module.functions(every, taken, "train")
        restored = module.restore(taken, functions)
        terms = module.loss_over_views(restored, taken.truth.to(restored.dtype))
        return terms["total"]

    return loss


def main() -> None:
    """Print the table, and how many rows agree."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lens", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--renderer", nargs="*", default=["rays"], choices=list(RENDERERS))
    parser.add_argument("--rays", type=int, default=24, help="strata along a side of the pupil")
    parser.add_argument("--pixels", type=int, default=24)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--share", type=float, default=0.02, help="what counts as agreement")
    parser.add_argument("--experiment", action="store_true", help="training losses of experiments")
    parser.add_argument(
        "--step",
        type=float,
        help="of the differences, in units of the scale (1e-5 where no edge cuts the light); "
        "default: one that changes the loss by some thousandths",
    )
    options = parser.parse_args()
    torch.manual_seed(0)
    if options.experiment:
        for title, lens, loss, names in training_losses():
            # The plate's lens and the doublet's windows are clipped by their stops alone.
            rows = gradient_rows(loss, lens, names, range(options.seeds), options.step or 1e-5)
            report(title, rows, options.share)
        return
    for title, lens, loss, names, other in cases(options):
        rows = gradient_rows(loss, lens, names, range(options.seeds), options.step, other)
        report(title, rows, options.share)


def cases(
    options: argparse.Namespace,
) -> Iterator[tuple[str, Lens, Loss, list[str], Loss | None]]:
    """Every lens by every renderer that was asked for.

    A plan of `auto` holds its disc in the pupil until it is looked at again, so its derivatives are
    compared with differences of renders by rays.
    """
    for name in options.lens:
        case = CASES[name]
        lens = case.lens()
        for renderer in options.renderer:
            loss = image_loss(case, lens, renderer, options.pixels, options.rays)
            rays = None
            if renderer == "auto":
                rays = image_loss(case, lens, "rays", options.pixels, options.rays)
            yield f"{name}, {renderer}", lens, loss, names_of(lens), rays


def report(title: str, rows: list[GradientRow], share: float) -> None:
    """A table, and a line that sums it up."""
    print(f"\n{title}")
    print(f"{'parameter':32s} {'autograd':>12s} {'difference':>12s} {'noise':>9s} {'error':>7s}")
    for row in rows:
        mark = "" if row.agrees(share) else "  *"
        print(
            f"{row.name:32s} {row.autograd:+12.4e} {row.difference:+12.4e} {row.noise:9.1e} "
            f"{100 * row.error:6.2f}%{mark}"
        )
    good = sum(row.agrees(share) for row in rows)
    first = torch.tensor([row.autograd for row in rows], dtype=torch.float64)
    second = torch.tensor([row.difference for row in rows], dtype=torch.float64)
    cosine = float(torch.cosine_similarity(first, second, dim=0))
    print(
        f"{good} of {len(rows)} agree within {100 * share:g} % or three standard errors; median "
        f"error {100 * statistics.median(row.error for row in rows):.2f} %; cosine {cosine:.6f}, "
        f"norm ratio {float(first.norm() / second.norm()):.4f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
