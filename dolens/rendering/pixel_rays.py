"""Light of pixels by the rays that they send through the exit pupil: the reference renderer.

PyTorch's operations, for scenes of any kind; the fused kernels must equal them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.kernels.view import View
from dolens.optics.ray_tracing import trace_components
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import distance_to_plane
from dolens.rendering.differentiable_geometry import DifferentiableGeometry, sample_weight
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.pupil.edge_rays import EdgeRays
from dolens.rendering.pupil.exit_pupil import ExitPupil
from dolens.rendering.pupil.pixel_edges import pixel_edge_rays, select_wavelength
from dolens.rendering.pupil.pupil_boundary import PupilBoundaryMap
from dolens.rendering.pupil.rays_to_exit_pupil import rays_to_exit_pupil
from dolens.rendering.random_numbers import random_words, uniform
from dolens.rendering.sampling import square_to_disc, stratified_square
from dolens.scene.scene import Scene, texture_coordinates
from dolens.sensor.pixels import Sensor


@dataclass(frozen=True)
class PixelRays:
    """Rays of a sensor's pixels, and the light that they bring from a scene.

    Attributes:
        scene: planes and wavelengths.
        sensor: the pixels.
        view: the same as numbers, with the samples of the pupil and the seed.
        edges: where apertures end the pixels' light, for gradients; None where they do not.
    """

    scene: Scene
    sensor: Sensor
    view: View
    edges: PupilBoundaryMap | None = None

    def samples(
        self, system: OpticalSystem, pupil: ExitPupil, start: int, end: int
    ) -> tuple[Components, Tensor]:
        """Rays (pixels, samples) from the sensor, and their weights, which sum to one on axis."""
        view = self.view
        side = view.pupil_samples
        pixel = torch.arange(start, end, device=system.device)[:, None]
        sample = torch.arange(side * side, device=system.device)
        jitters = [uniform(word, system.dtype) for word in random_words(view.seed, pixel, sample)]
        disc_x, disc_y = square_to_disc(*stratified_square(side, *jitters[:2]))
        rows = torch.div(pixel, view.width, rounding_mode="floor").to(system.dtype)
        columns = (pixel % view.width).to(system.dtype)
        if view.pixel_area:
            rows, columns = rows + (jitters[2] - 0.5), columns + (jitters[3] - 0.5)
        x, y = self.sensor.positions(rows, columns)
        sensor_z = system.vertices[-1]
        radius = pupil.radius
        ray = rays_to_exit_pupil(x, y, sensor_z, disc_x * radius, disc_y * radius, pupil.z)
        return ray, (ray.n * ray.n) ** 2 * sample_weight(system, view, pupil)

    def rim(self, system: OpticalSystem, pupil: ExitPupil, start: int, end: int) -> EdgeRays | None:
        """Rays along the edges of apertures; None where no gradient asks for them."""
        imaging = ImagingSystem(system, self.scene, self.sensor, pupil)
        return pixel_edge_rays(imaging, self.view, self.edges, start, end)

    def light(
        self,
        system: OpticalSystem,
        moving: DifferentiableGeometry,
        shown: tuple[Tensor, ...],
        start: int,
        end: int,
    ) -> Tensor:
        """Light of pixels `start` to `end`: (B, images, C, end - start).

        Args:
            system: the lens.
            moving: the pupil and the magnifications, as they move with it.
            shown: what the planes show, of `Scene.on_planes`.
            start: number of the first pixel.
            end: number behind the last.
        """
        ray, weight = self.samples(system, moving.pupil, start, end)
        rim = self.rim(system, moving.pupil, start, end)
        channels = []
        for channel, wavelength in enumerate(self.scene.wavelengths):
            there, valid = trace_components(system, ray, wavelength, -1.0)
            arriving = torch.where(valid & (there.n < 0.0), weight, 0.0)
            if rim is not None:
                # Rays along the edges stand beside the samples.
                beside = select_wavelength(rim.ray, channel)
                there = Components(
                    *(torch.cat(pair, -1) for pair in zip(there, beside, strict=True))
                )
                arriving = torch.cat((arriving, rim.weight[channel]), -1)
            places = self._texture_places(moving.magnifications, there)
            channels.append(self.scene.gather(shown, channel, places, arriving))
        return torch.stack(channels, dim=2)

    def edge_light(
        self,
        system: OpticalSystem,
        moving: DifferentiableGeometry,
        shown: tuple[Tensor, ...],
        start: int,
        end: int,
        still: Sequence[float],
    ) -> Tensor:
        """Zeros (B, images, C, end - start) whose gradients are those of light at apertures' edges.

        Arguments as of `light`, and the magnifications as numbers; of the scene, planes that make
        images of their own.
        """
        rim = self.rim(system, moving.pupil, start, end)
        depths, wavelengths = self.scene.depths, self.scene.wavelengths
        if rim is None:
            shape = (shown[0].shape[0], len(depths), len(wavelengths), end - start)
            return shown[0].new_zeros(shape)
        channels = [
            self.scene.gather(
                shown,
                channel,
                self._texture_places(still, select_wavelength(rim.ray, channel)),
                rim.weight[channel],
            )
            for channel in range(len(wavelengths))
        ]
        return torch.stack(channels, dim=2)

    def _texture_places(
        self, magnifications: Sequence[float | Tensor], there: Components
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Rows and columns of the texture where rays meet one plane after the other."""
        view = self.view
        origin = (view.texture_row, view.texture_column)
        for depth, magnification in zip(view.depths, magnifications, strict=True):
            t, _ = distance_to_plane(there, -depth, -1.0)
            x = torch.addcmul(there.x, t, there.l)
            y = torch.addcmul(there.y, t, there.m)
            yield texture_coordinates(x, y, magnification, view.pixel_pitch, origin)
