"""Lenses, scenes and renderers whose images are differentiated."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.probes import probe_texture
from dolens.rendering.gradient_check import Loss
from dolens.rendering.protocol import Renderer
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor

ROOT = Path(__file__).resolve().parents[2]
LINES = (656.2725, 587.5618, 486.1327)
RENDERERS = ("rays", "rays_reference", "psf", "wave", "auto")


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
        import yaml

        path = ROOT / "conf" / "lens" / f"{self.file}.yaml"
        prescription = yaml.safe_load(path.read_text(encoding="utf-8"))
        if self.elements:
            prescription["elements"] = dict(self.elements)
        lens = lens_from_prescription(prescription, torch.float64, where=str(path))
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
        return (renderer.render(lens, scene, texture, seed, values) - truth).square().mean()

    return loss
