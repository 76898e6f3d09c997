"""A lens before probe images: the errors of renderers there, in the image and in its gradient."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.rendering.auto.field_grid import psf_cost, rays_cost
from dolens.rendering.auto.plan import Plan, Requirements, plan, union
from dolens.rendering.auto.probes import Reference, probe_texture, rays_samples, reference
from dolens.rendering.chief_ray_map import chief_ray_maps
from dolens.rendering.exit_pupil import paraxial_exit_pupil
from dolens.rendering.gradient_check import (
    Agreement,
    Render,
    agreement,
    gradient,
    gradients_of_rays,
    image_measure,
    reference_strata,
)
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.protocol import Measure, Renderer, SensorWindow, Values
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, as_planes, pinhole_image
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# The reference's samples along each side of the pupil.
_REFERENCE_SAMPLES = 24
# Sides of the reference's parts, pixels: of the whole sensor, and of each of several windows.
_SIDE, _SIDE_OF_WINDOW = 24, 12


@dataclass(frozen=True)
class ProbeSet:
    """The parts of a sensor that renderers are tried on, and the images that are shown to them.

    Attributes:
        sensor: the whole one.
        seed: of the probe images and of rays.
        windows: by name, of the sensor, rendered together; none: the whole sensor by itself.
        photographs: (P, 3, h, w), linear light, beside the probe images of `probe_texture`; or
            None.
    """

    sensor: Sensor
    seed: int = 0
    windows: Mapping[str, Sensor] = field(default_factory=dict)
    photographs: Tensor | None = None


class Trial:
    """One lens as it is, and what rays make of the probe images and of their gradients.

    Args:
        lens: the lens.
        scene: what it looks at; the probe images stand in its planes.
        probes: the sensor, its windows and the images.
        requirements: the conditions that plans keep to.
        measure: of gradients; None: where they matter, of the whole sensor's image with respect to
            those of the lens's given values that require them, `image_measure`.
    """

    def __init__(
        self,
        lens: Lens,
        scene: Scene,
        probes: ProbeSet,
        requirements: Requirements,
        measure: Measure | None = None,
    ) -> None:
        self.probes, self.requirements = probes, requirements
        self.scene, self.separate_planes = as_planes(scene), scene.separate_planes
        values = lens.given if requirements.gradients else {}
        lens = lens.storing_its_values()
        self._single, self._double = (
            copy.deepcopy(lens).to(dtype) for dtype in (torch.float32, torch.float64)
        )
        self.windows = self._windows()
        channels = len(scene.wavelengths)
        self._textures = [
            probe_texture(w.sensor, channels, probes.seed, probes.photographs) for w in self.windows
        ]
        self._references = self._rendered_by_rays()
        self.uncertainty = max(found.uncertainty for found in self._references)
        # Of windows, each texture has one to itself.
        self._each = list(self.windows)
        if probes.windows:
            self._each = [w for w in self.windows for _ in self._textures[0]]
        self._measure = None
        if measure is not None:
            self._measure = measure(self._each)
        elif not probes.windows and any(v.requires_grad for v in values.values()):
            (window,), (textures,) = self.windows, self._textures
            truth = pinhole_image(textures, window.sensor, window.texture_centre)[:, None]
            self._measure = image_measure(values, truth)
        self._of_rays: tuple[Tensor, Tensor] | None = None

    def lens(self, dtype: torch.dtype) -> Lens:
        """The lens in a precision."""
        return self._single if dtype == torch.float32 else self._double

    def plan(self, tolerance: float) -> Plan:
        """Functions that are expected to err by a tolerance."""
        requirements = replace(self.requirements, tolerance=tolerance)
        plans = []
        for window in self.windows:
            single, double = (
                ImagingSystem.of(lens.system(), self.scene, window.sensor)
                for lens in (self._single, self._double)
            )
            plans.append(plan(single, double, requirements))
        if not self.probes.windows:
            return plans[0]
        return union(dict(zip(self.probes.windows, plans, strict=True)), self.probes.sensor)

    def errors(self, renderer: Renderer, dtype: torch.dtype) -> dict[str, float]:
        """Grey levels against the reference, both without diffraction, by the windows' names; of
        the whole sensor by "".
        """
        render = self._rendered(renderer.without_diffraction(), dtype)
        image = render({}, self.probes.seed + 1)
        parts = image.split(len(self._textures[0]))
        found = (judge.error(part) for judge, part in zip(self._references, parts, strict=True))
        return dict(zip(self.probes.windows or ("",), found, strict=True))

    def agreement(self, renderer: Renderer, dtype: torch.dtype) -> Agreement | None:
        """Compare a renderer's gradients with those of rays, both without diffraction; None where
        none are asked for.
        """
        measure, seed = self._measure, self.probes.seed
        if measure is None or not measure.variables:
            return None
        textures = torch.cat(self._textures)
        if self._of_rays is None:
            window = self._each[0].sensor
            side = reference_strata(
                window.height, window.width * len(self._each), len(self.scene.wavelengths)
            )
            rays = self._rendered(RayRenderer(self.probes.sensor, side), torch.float32)
            self._of_rays = gradients_of_rays(rays, textures, measure, seed + 2)
        rendered = self._rendered(renderer.without_diffraction(), dtype)
        if renderer.monte_carlo:
            # Two renders, so that what their noise does to a squared error is left out here too.
            own = gradients_of_rays(rendered, textures, measure, seed + 4)
            return agreement(0.5 * (own[0] + own[1]), self._of_rays)
        return agreement(gradient(rendered, textures, measure, (seed + 4,)), self._of_rays)

    def rays_instead(self, renderer: PsfRenderer) -> tuple[int, float, float]:
        """Estimate the strata that rays would need for the whole sensor, the noise they would leave
        in grey levels, and their cost over that of functions.
        """
        surfaces, (window,), (textures,) = len(self._single.surfaces), self.windows, self._textures
        samples, noise = rays_samples(
            self._single,
            self._placed(window),
            window.sensor,
            textures,
            self.requirements.tolerance,
        )
        of_rays = rays_cost(window.sensor, samples**2, self.scene, surfaces)
        return samples, noise, of_rays / psf_cost(renderer, self.scene, surfaces)

    def _windows(self) -> Sequence[SensorWindow]:
        """The parts of the sensor with their object points, to a whole texel."""
        sensor, windows = self.probes.sensor, list(self.probes.windows.values())
        if not windows:
            centre = (float(round(sensor.centre_row)), float(round(sensor.centre_column)))
            return [SensorWindow(sensor, centre)]
        system, wavelengths = self._double.system(), (self.scene.middle_wavelength,)
        middle = as_planes(self.scene, wavelengths=wavelengths)
        pupil = paraxial_exit_pupil(system, wavelengths)
        object_points = chief_ray_maps(ImagingSystem(system, middle, sensor, pupil), windows)
        return [
            SensorWindow(window, (float(row.mean().round()), float(column.mean().round())))
            for window, (row, column) in zip(windows, object_points, strict=True)
        ]

    def _rendered_by_rays(self) -> Sequence[Reference]:
        side = _SIDE_OF_WINDOW if self.probes.windows else _SIDE
        return [
            reference(
                RayRenderer(window.sensor, _REFERENCE_SAMPLES),
                self._single,
                self._placed(window),
                textures,
                self.probes.seed,
                side,
            )
            for window, textures in zip(self.windows, self._textures, strict=True)
        ]

    def _rendered(self, renderer: Renderer, dtype: torch.dtype) -> Render:
        """Images of all probe images as functions of the lens's values and a seed."""
        lens, textures = self.lens(dtype), torch.cat(self._textures)

        def render(values: Values, seed: int) -> Tensor:
            cast = {name: value.to(dtype) for name, value in values.items()}
            if self.probes.windows:
                each = self._each
                return renderer.render_windows(
                    lens.with_values(cast), self.scene, textures, each, seed
                )
            placed = self._placed(self.windows[0])
            return renderer.render(lens.with_values(cast), placed, textures, seed)

        return render

    def _placed(self, window: SensorWindow) -> PlanarScene:
        """The scene with its textures at the object points of a window."""
        return replace(self.scene, texture_centre=window.texture_centre)
