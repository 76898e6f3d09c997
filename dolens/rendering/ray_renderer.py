"""Backward-mode rendering: from pixels through the exit pupil and the lens to textured planes.

Two implementations of one computation, with the same samples: fused kernels, for planes that make
images of their own, and PyTorch's operations, the reference that they must equal.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.kernels.rendering import View
from dolens.optics.autograd import replay
from dolens.optics.lens import Lens
from dolens.optics.packing import pack
from dolens.optics.ray_tracing import say_once, trace_components, with_chosen_backend
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem, require_seen_by_rays
from dolens.optics.trace import distance_to_plane
from dolens.rendering.aperture_edges import (
    EdgeRays,
    PupilBoundaryMap,
    edge_rays,
    pupil_boundary_map,
)
from dolens.rendering.differentiable_geometry import (
    DifferentiableGeometry,
    depends_on_parameters,
    differentiable_geometry,
    sample_weight,
)
from dolens.rendering.exit_pupil import (
    ExitPupil,
    axial_exit_pupil,
    rays_to_exit_pupil,
    sampled_exit_pupil,
)
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.protocol import Renderer, SensorWindow
from dolens.rendering.relative_illumination import transmission_map
from dolens.rendering.sampling import random_words, square_to_disc, stratified_square, uniform
from dolens.scene.scene import Scene, texture_coordinates, texture_origin
from dolens.sensor.noise import generator_of
from dolens.sensor.pixels import Sensor


@dataclass(frozen=True)
class RayRenderer(Renderer):
    """Monte Carlo rendering: jittered points of each pixel, a stratified sampling of the pupil.

    Each pixel sends `pupil_samples`² rays: one from a random point of the pixel through a random
    point of each stratum of the exit pupil.  All wavelengths share the samples.  The irradiance
    of a pixel is the mean over the pupil of radiance · cos⁴, relative to the axis, so that a white
    plane renders white on the axis and falls off where the lens does.  A lens with coatings makes
    it darker, by the mean over the pupil of what passes (see `transmission_map`).

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
    ) -> Tensor:
        """Image each texture on a window of its own; see `Renderer.render_windows`."""
        axial, images = self.axial_pupil(lens, scene), []
        for i, window in enumerate(windows):
            renderer = self.on(window.sensor)
            placed = replace(scene, texture_centre=window.texture_centre)
            texture = textures[i : i + 1]
            images.append(renderer.render(lens, placed, texture, seed + i, axial))
        return torch.cat(images)

    def axial_pupil(self, lens: Lens, scene: Scene) -> ExitPupil:
        """Find the axial exit pupil once, for many renders of the same lens.

        Raises:
            InputError: no ray from the sensor's centre gets through.
        """
        still = {name: value.detach() for name, value in lens.given.items()}
        return axial_exit_pupil(lens.system(still), scene.wavelengths)

    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
        axial: ExitPupil | None = None,
    ) -> Tensor:
        """Image textures as a scene shows them.

        Args:
            lens: the lens; its precision is the rays'.
            scene: planes, wavelengths, and what textures mean.
            textures: (B, channels, H, W), linear light, as the scene takes them.
            seed: the same seed gives the same samples, whatever ran before.
            axial: what `axial_pupil` found for this lens; None: it is asked here.

        Returns:
            (B, images, C, height, width), linear light, in the lens's precision; of a planar scene
            an image for each depth.  Differentiable in the lens's parameters and values and the
            textures.

        Raises:
            InputError: a depth inside the lens, or channels that are not the scene's.
        """
        image = self._ideal_image(lens, scene, textures, seed, axial)
        coated = lens.system()
        if not coated.coated:
            return image
        pupil = sampled_exit_pupil(coated, scene.wavelengths, self.sensor, axial).numbers()
        passed = transmission_map(ImagingSystem(coated, scene, self.sensor, pupil))
        return image if passed is None else image * passed.to(image)

    def _ideal_image(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
        axial: ExitPupil | None,
    ) -> Tensor:
        """Return the image of a lens that loses no light; arguments are those of `render`."""
        stored = {n: p for n, p in lens.named_parameters() if p.requires_grad}
        parameters = {**stored, **lens.given}
        textures = textures.to(device=lens.device, dtype=lens.dtype)
        shown = scene.on_planes(textures)
        system = with_chosen_backend(lens.system(parameters).uncoated(), [textures])
        backend = system.backend
        still = lens.system({n: p.detach() for n, p in parameters.items()}).uncoated()
        now = still.traced_by(backend)
        require_seen_by_rays(now, "renderer rays")
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
                lens.system(values).uncoated().traced_by(backend),
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


# Rays a pixel and wavelength, where edges cut light: as many as half the strata along a side of the
# pupil, since an edge is a line.
_FEWEST = 2


def edge_samples(pupil_samples: int) -> int:
    """Rays along edges for each pixel and wavelength, beside strata along a side of the pupil."""
    return max(_FEWEST, pupil_samples // 2)


def pixel_edge_rays(
    imaging: ImagingSystem, view: View, edges: PupilBoundaryMap | None, start: int, end: int
) -> EdgeRays | None:
    """Rays (C, pixels, samples) of pixels `start` to `end`; None where no gradient asks for them.

    Args:
        imaging: the lens, C wavelengths, the pixels, and the pupil's disc as it moves with the
            lens.
        view: of the render, for its seed.
        edges: where edges are; None where they cut nothing.
        start: number of the first pixel.
        end: number behind the last.
    """
    system = imaging.system
    if edges is None or not depends_on_parameters(system):
        return None
    pixel = torch.arange(start, end, device=system.device)[:, None]
    count = edge_samples(view.pupil_samples)
    stratum = torch.arange(count, device=system.device)
    # Beyond the numbers of the pupil's samples.
    words = random_words(view.seed, pixel, stratum + view.pupil_samples**2)
    jitter, _, *area = (uniform(word, system.dtype) for word in words)
    angle = (stratum + jitter) * (2.0 * math.pi / count)
    rows = torch.div(pixel, view.width, rounding_mode="floor").to(system.dtype)[:, 0]
    columns = (pixel % view.width).to(system.dtype)[:, 0]
    if view.pixel_area:
        # One place serves all azimuths of a pixel.
        rows, columns = rows + (area[0][:, 0] - 0.5), columns + (area[1][:, 0] - 0.5)
    points = imaging.sensor.positions(rows, columns)
    edge = edges.at(*points, angle)
    return edge_rays(system, imaging.scene.wavelengths, points, imaging.pupil, edge)


def select_wavelength(ray: Components, channel: int) -> Components:
    """Rays of one wavelength."""
    return Components(*(component[channel] for component in ray))
