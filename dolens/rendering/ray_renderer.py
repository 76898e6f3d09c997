"""Backward-mode rendering: from pixels through the exit pupil and the lens to textured planes.

Two implementations of one computation, with the same samples: fused kernels, for planes that make
images of their own, and PyTorch's operations, the reference that they must equal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.kernels.view import View
from dolens.optics.backend import say_once, with_chosen_backend
from dolens.optics.lens import Lens
from dolens.optics.packing import pack
from dolens.optics.replay import replay
from dolens.optics.system import OpticalSystem
from dolens.rendering.differentiable_geometry import DifferentiableGeometry, differentiable_geometry
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.pixel_rays import PixelRays
from dolens.rendering.protocol import Renderer, SensorWindow
from dolens.rendering.pupil.differentiable_pupil import depends_on_parameters
from dolens.rendering.pupil.exit_pupil import ExitPupil, axial_exit_pupil, sampled_exit_pupil
from dolens.rendering.pupil.pixel_edges import edge_samples
from dolens.rendering.pupil.pupil_boundary import pupil_boundary_map
from dolens.scene.scene import Scene, texture_origin
from dolens.sensor.noise import generator_of
from dolens.sensor.pixels import Sensor


@dataclass(frozen=True)
class RayRenderer(Renderer):
    """Monte Carlo rendering: jittered points of each pixel, a stratified sampling of the pupil.

    Each pixel sends `pupil_samples`² rays: one from a random point of the pixel through a random
    point of each stratum of the exit pupil.  All wavelengths share the samples.  The irradiance
    of a pixel is the mean over the pupil of radiance · cos⁴, relative to the axis, so that a white
    plane renders white on the axis and falls off where the lens does.

    Attributes:
        sensor: the pixels.
        pupil_samples: strata along each side; rays a pixel are its square.
        chunk_rays: rays that the reference traces at a time; sets its memory, not the image.
        replay: recompute each chunk in the backward pass, so that memory stays bounded; the fused
            kernels always do.
        gradient_fraction: share of the chunks that the backward pass recomputes, drawn at random
            for each seed; below 1 the gradient is an unbiased estimate, and the image is whole.
        pixel_area: sample over the pixel's area (a real pixel integrates), or at its centre.
    """

    sensor: Sensor
    pupil_samples: int = 7
    chunk_rays: int = 65536
    replay: bool = True
    gradient_fraction: float = 1.0
    pixel_area: bool = True

    model: ClassVar[str] = "rays"
    monte_carlo: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.pupil_samples < 1 or self.chunk_rays < 1:
            raise InputError("renderer: pupil_samples and chunk_rays must be at least 1")
        if not 0.0 < self.gradient_fraction <= 1.0:
            raise InputError("renderer: gradient_fraction must be above 0 and at most 1")
        if self.gradient_fraction < 1.0 and not self.replay:
            raise InputError("renderer: gradient_fraction below 1 needs replay")

    def rays_per_image(self, scene: Scene, sensor: Sensor | None = None) -> int:
        """Rays traced through the lens for one render, all wavelengths together."""
        sensor = sensor or self.sensor
        return sensor.height * sensor.width * self.pupil_samples**2 * len(scene.wavelengths)

    def render_windows(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[SensorWindow],
        seed: int,
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Image each texture on a window of its own; see `Renderer.render_windows`."""
        axial, images = self.axial_pupil(lens, scene, values), []
        for i, window in enumerate(windows):
            renderer = self.on(window.sensor)
            placed = replace(scene, texture_centre=window.texture_centre)
            texture = textures[i : i + 1]
            images.append(renderer.render(lens, placed, texture, seed + i, values, axial))
        return torch.cat(images)

    def axial_pupil(
        self, lens: Lens, scene: Scene, values: Mapping[str, Tensor] | None = None
    ) -> ExitPupil:
        """Find the axial exit pupil once, for many renders of the same lens.

        Raises:
            InputError: no ray from the sensor's centre gets through.
        """
        still = {name: value.detach() for name, value in (values or {}).items()}
        system = lens.system(still)
        return axial_exit_pupil(system, scene.wavelengths)

    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
        values: Mapping[str, Tensor] | None = None,
        axial: ExitPupil | None = None,
    ) -> Tensor:
        """Image textures as a scene shows them.

        Args:
            lens: the lens; its precision is the rays'.
            scene: planes, wavelengths, and what textures mean.
            textures: (B, channels, H, W), linear light, as the scene takes them.
            seed: the same seed gives the same samples, whatever ran before.
            values: lens parameters to use instead of the stored ones.
            axial: what `axial_pupil` found for this lens and these values; None: it is asked here.

        Returns:
            (B, images, C, height, width), linear light, in the lens's precision; of a planar scene
            an image for each depth.  Differentiable in the lens's parameters, `values` and the
            textures.

        Raises:
            InputError: a depth inside the lens, or channels that are not the scene's.
        """
        stored = {n: p for n, p in lens.named_parameters() if p.requires_grad}
        parameters = {**stored, **(values or {})}
        textures = textures.to(device=lens.device, dtype=lens.dtype)
        shown = scene.on_planes(textures)
        system = with_chosen_backend(lens.system(parameters), [textures])
        backend = system.backend
        now = lens.system({n: p.detach() for n, p in parameters.items()}).traced_by(backend)
        scene.check(now)
        pupil = sampled_exit_pupil(now, scene.wavelengths, self.sensor, axial)
        view = self._view(now, scene, (textures.shape[-2], textures.shape[-1]), seed, pupil)
        moving = differentiable_geometry(system, scene, view)
        edges = None
        if depends_on_parameters(system):
            edges = pupil_boundary_map(
                ImagingSystem(now, scene, self.sensor, moving.pupil.numbers())
            )
        rays = PixelRays(scene, self.sensor, view, edges)
        names, planes = list(parameters), len(shown)

        def moved(
            tensors: Sequence[Tensor],
        ) -> tuple[OpticalSystem, DifferentiableGeometry, tuple[Tensor, ...]]:
            """The lens, the view and what planes show, from a piece's own tensors."""
            values = dict(zip(names, tensors[planes:-1], strict=True))
            return (
                lens.system(values).traced_by(backend),
                moving.of(tensors[-1]),
                tuple(tensors[:planes]),
            )

        fused = backend == "cpu" and scene.separate_planes
        if fused:
            image = self._fused(system, scene, textures, view, moving)
            if edges is None:
                return image
        leaves = [*parameters.values(), moving.joined(system)]
        if fused:
            pieces = self._pieces(self.chunk_rays // edge_samples(self.pupil_samples))

            def edge_light(i: int, *tensors: Tensor) -> Tensor:
                now, geometry, planes_shown = moved(tensors)
                return rays.edge_light(now, geometry, planes_shown, *pieces[i], moving.still)

            tensors = [*(t.detach() for t in shown), *leaves]
            return image + self._image(replay(edge_light, _sizes(pieces), tensors))
        if backend != "reference":
            what = "cuda" if scene.separate_planes else "layers"
            say_once(f"render: no fused renderer for {what}; the reference, with fused traces")
        pieces = self._chunks

        def light(i: int, *tensors: Tensor) -> Tensor:
            now, geometry, planes_shown = moved(tensors)
            return rays.light(now, geometry, planes_shown, *pieces[i])

        tensors = [*shown, *leaves]
        if self.replay:
            return self._image(replay(light, _sizes(pieces), tensors, self._replayed(seed)))
        return self._image(torch.cat([light(i, *tensors) for i in range(len(pieces))], dim=-1))

    def _image(self, flat: Tensor) -> Tensor:
        """(..., height, width) of (..., pixels)."""
        return flat.unflatten(-1, (self.sensor.height, self.sensor.width))

    def _view(
        self,
        system: OpticalSystem,
        scene: Scene,
        texture_size: tuple[int, int],
        seed: int,
        pupil: ExitPupil,
    ) -> View:
        """Return pixels, samples, pupil and planes as numbers, without the lens's gradient."""
        sensor = self.sensor
        return View(
            sensor.height,
            sensor.width,
            sensor.pixel_pitch,
            self.pupil_samples,
            self.pixel_area,
            seed,
            0.5 * (sensor.height - 1) - sensor.centre_row,
            0.5 * (sensor.width - 1) - sensor.centre_column,
            *texture_origin(texture_size, scene.texture_centre),
            pupil.z,
            pupil.radius,
            pupil.axial_radius,
            scene.depths,
            tuple(scene.magnifications(system)),
        )

    def _pieces(self, pixels: int) -> list[tuple[int, int]]:
        """First pixels and ends of pieces of so many pixels, one at least."""
        count, step = self.sensor.height * self.sensor.width, max(1, pixels)
        return [(start, min(start + step, count)) for start in range(0, count, step)]

    @property
    def _chunks(self) -> list[tuple[int, int]]:
        """First pixels and ends of what the reference traces at a time."""
        return self._pieces(self.chunk_rays // self.pupil_samples**2)

    def _replayed(self, seed: int) -> list[int]:
        """The chunks that the backward pass traces again."""
        chunks = len(self._chunks)
        count = max(1, round(self.gradient_fraction * chunks))
        generator = generator_of(seed)
        return torch.randperm(chunks, generator=generator)[:count].tolist()

    def _fused(
        self,
        system: OpticalSystem,
        scene: Scene,
        textures: Tensor,
        view: View,
        moving: DifferentiableGeometry,
    ) -> Tensor:
        """The render in one kernel."""
        wavelengths = torch.tensor(scene.wavelengths, dtype=torch.float64)
        table = pack(system, wavelengths, -1.0, 1, len(system.surfaces), False)
        pieces, scale = [(0, view.height * view.width)], 1.0
        if self.gradient_fraction < 1.0:
            replayed, chunks = self._replayed(view.seed), self._chunks
            pieces = [chunks[i] for i in sorted(replayed)]
            scale = len(chunks) / len(replayed)
        return rendering.render(
            table.values,
            table.indices,
            textures,
            system.vertices[-1],
            moving.packed_for_kernel(system, view),
            table.codes,
            table.extras,
            view.integers(),
            view.numbers(),
            torch.tensor(pieces),
            scale,
        )


def _sizes(pieces: Sequence[tuple[int, int]]) -> list[int]:
    """Pixels of each piece."""
    return [end - start for start, end in pieces]
