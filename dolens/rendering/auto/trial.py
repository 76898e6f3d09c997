"""A lens before probe images: what renderers err by there, in the image and in its gradient."""

import copy
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.rendering.auto.agreement import (
    Agreement,
    GradientMeasure,
    agreement,
    gradient,
    gradients_of_rays,
    image_measure,
    judging_samples,
)
from dolens.rendering.auto.cost import psf_cost, rays_cost
from dolens.rendering.auto.plan import Plan, Requirements, plan
from dolens.rendering.auto.probe import probe_texture
from dolens.rendering.auto.reference import rays_samples, reference
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import Scene, pinhole_image
from dolens.sensor.pixels import Sensor

# The reference's samples along each side of the pupil.
REFERENCE_SAMPLES = 24


class Trial:
    """One lens as it is, and what rays make of the probe images and of their gradients.

    Args:
        current: the lens.
        scene: what it looks at; the probe images stand in its planes.
        sensor: the pixels.
        values: the lens's parameters by name; gradients are of those that require them.
        measure: of gradients; None: `image_measure` of the values.
        gradients: whether plans are made for gradients.
        diffraction: whether it may be modelled.
        tolerance: grey levels.
        seed: of the probes and of rays.
        photographs: probes besides, of `probe_texture`.
    """

    def __init__(
        self,
        current: Lens,
        scene: Scene,
        sensor: Sensor,
        values: Mapping[str, Tensor] | None,
        measure: GradientMeasure | None,
        gradients: bool,
        diffraction: bool,
        tolerance: float,
        seed: int,
        photographs: Tensor | None = None,
    ) -> None:
        self.sensor, self.tolerance, self.seed = sensor, tolerance, seed
        self.gradients, self.diffraction = gradients, diffraction
        self._single, self._double = in_both_precisions(current)
        self.texture = probe_texture(sensor, len(scene.wavelengths), seed, photographs)
        centre = (float(round(sensor.centre_row)), float(round(sensor.centre_column)))
        self.scene = scene.as_planes(texture_centre=centre)
        self._planned = scene.as_planes()
        self._judge = reference(
            self._single, self.scene, sensor, self.texture, REFERENCE_SAMPLES, seed
        )
        self.uncertainty = self._judge.uncertainty
        self._measure = measure
        if measure is None and any(v.requires_grad for v in (values or {}).values()):
            truth = pinhole_image(self.texture, sensor, centre)[:, None]
            self._measure = image_measure(values, truth)
        self._of_rays: tuple[Tensor, Tensor] | None = None

    def lens(self, dtype: torch.dtype) -> Lens:
        """The lens in a precision."""
        return self._single if dtype == torch.float32 else self._double

    def plan(self, tolerance: float) -> Plan:
        """Functions that are expected to err by a tolerance."""
        single, double = (
            ImagingSystem.of(lens.system(), self._planned, self.sensor)
            for lens in (self._single, self._double)
        )
        return plan(single, double, Requirements(tolerance, self.gradients, self.diffraction))

    def error(self, renderer: PsfRenderer | RayRenderer, dtype: torch.dtype) -> float:
        """Grey levels against the reference, both without diffraction."""
        renderer = without_diffraction(renderer)
        image = renderer.render(self.lens(dtype), self.scene, self.texture, self.seed + 1)
        return self._judge.error(image)

    def agreement(
        self, renderer: PsfRenderer | RayRenderer, dtype: torch.dtype
    ) -> Agreement | None:
        """How well gradients agree with those of rays, both without diffraction; None where none
        is asked for.
        """
        if self._measure is None or not self._measure.variables:
            return None
        if self._of_rays is None:
            sensor = self.sensor
            side = judging_samples(sensor.height, sensor.width, len(self.scene.wavelengths))
            rays = self._rendered(RayRenderer(sensor, side), torch.float32)
            self._of_rays = gradients_of_rays(rays, self.texture, self._measure, self.seed + 2)
        rendered = self._rendered(without_diffraction(renderer), dtype)
        if isinstance(renderer, RayRenderer):
            # Two renders, so that what their noise does to a squared error is left out here too.
            own = gradients_of_rays(rendered, self.texture, self._measure, self.seed + 4)
            return agreement(0.5 * (own[0] + own[1]), self._of_rays)
        found = gradient(rendered, self.texture, self._measure, (self.seed + 4,))
        return agreement(found, self._of_rays)

    def rays_instead(self, renderer: PsfRenderer) -> tuple[int, float, float]:
        """How many strata rays would need, the noise they would leave in grey levels, and their
        cost over that of functions.
        """
        surfaces, planes = len(self._single.surfaces), self._planned
        samples, noise = rays_samples(
            self._single, self.scene, self.sensor, self.texture, self.tolerance
        )
        of_rays = rays_cost(self.sensor, samples**2, planes, surfaces)
        return samples, noise, of_rays / psf_cost(renderer, planes, surfaces)

    def _rendered(self, renderer: PsfRenderer | RayRenderer, dtype: torch.dtype):  # noqa: ANN202
        lens = self.lens(dtype)

        def render(values: Mapping[str, Tensor], seed: int) -> Tensor:
            cast = {name: value.to(dtype) for name, value in values.items()}
            return renderer.render(lens, self.scene, self.texture, seed, cast)

        return render


def without_diffraction(renderer: PsfRenderer | RayRenderer) -> PsfRenderer | RayRenderer:
    """What a renderer makes of rays alone."""
    if isinstance(renderer, PsfRenderer):
        return replace(renderer, diffraction="none")
    return renderer


def with_values(lens: Lens, values: Mapping[str, Tensor] | None) -> Lens:
    """The lens with some parameters, and semi-diameters, replaced as `Lens.system` does."""
    changed = copy.deepcopy(lens)
    parameters = dict(changed.named_parameters())
    for name, value in (values or {}).items():
        if name in parameters:
            parameters[name].copy_(value)
            continue
        surface = changed.surfaces[name.split(".")[1]]
        surface.aperture = surface.aperture.resized(float(value.detach()))
    return changed


def in_both_precisions(lens: Lens) -> tuple[Lens, Lens]:
    """Copies in single and in double precision."""
    single, double = (copy.deepcopy(lens).to(d) for d in (torch.float32, torch.float64))
    return single, double
