"""Backward-mode rendering: from pixels through the exit pupil and the lens to textured planes.

Two implementations of one computation, with the same samples: fused kernels, for planes that make
images of their own, and PyTorch's operations, the reference that they must equal.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.kernels.view import View
from dolens.optics.backend import say_once, trace_components, with_chosen_backend
from dolens.optics.lens import Lens
from dolens.optics.packing import pack
from dolens.optics.rays import Components
from dolens.optics.replay import replay
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import distance_to_plane
from dolens.rendering.moving_view import MovingView, moving_view, sample_share
from dolens.rendering.protocol import Unprepared
from dolens.rendering.pupil.aim import aim
from dolens.rendering.pupil.edge_rays import EdgeRays
from dolens.rendering.pupil.exit_pupil import ExitPupil, axial_exit_pupil, sampled_exit_pupil
from dolens.rendering.pupil.light_edges import EdgeMap, edge_map
from dolens.rendering.pupil.moving_pupil import depends_on_parameters
from dolens.rendering.pupil.pixel_edges import edge_samples, of_channel, pixel_edge_rays
from dolens.rendering.random_numbers import random_words, uniform
from dolens.rendering.sampling import square_to_disc, stratified_square
from dolens.scene.planar import Scene, texture_coordinates, texture_origin
from dolens.sensor.pixels import Sensor

_SEED_RANGE = 2**63 - 1


@dataclass(frozen=True)
class RayRenderer(Unprepared):
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

    def __post_init__(self) -> None:
        if self.pupil_samples < 1 or self.chunk_rays < 1:
            raise InputError("renderer: pupil_samples and chunk_rays must be at least 1")
        if not 0.0 < self.gradient_fraction <= 1.0:
            raise InputError("renderer: gradient_fraction must be above 0 and at most 1")
        if self.gradient_fraction < 1.0 and not self.replay:
            raise InputError("renderer: gradient_fraction below 1 needs replay")

    def rays_per_image(self, scene: Scene) -> int:
        """Rays traced through the lens for one render, all wavelengths together."""
        pixels = self.sensor.height * self.sensor.width
        return pixels * self.pupil_samples**2 * len(scene.wavelengths)

    def render_windows(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[Sensor],
        centres: Sequence[tuple[float, float]],
        seed: int,
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Image each texture on a window of its own; as `PsfRenderer.render_windows`.

        Returns:
            (W, images, C, height, width).
        """
        axial, images = self.axial_pupil(lens, scene, values), []
        for i, (window, centre) in enumerate(zip(windows, centres, strict=True)):
            renderer, placed = replace(self, sensor=window), replace(scene, texture_centre=centre)
            texture = textures[i : i + 1]
            images.append(renderer.render(lens, placed, texture, seed + i, values, axial))
        return torch.cat(images)

    def axial_pupil(
        self, lens: Lens, scene: Scene, values: Mapping[str, Tensor] | None = None
    ) -> ExitPupil:
        """What `render` finds of a lens before anything else, for many renders of the same lens.

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
        moving = moving_view(system, scene, view)
        edges = None
        if depends_on_parameters(system):
            still = moving.pupil.numbers()
            edges = edge_map(now, scene.wavelengths, self.sensor, still)
        if backend == "cpu" and scene.separate_planes:
            image = self._fused(system, scene, textures, view, moving)
            if edges is None:
                return image
            return image + self._edge_light(lens, parameters, scene, shown, view, moving, edges)
        if backend != "reference":
            what = "cuda" if scene.separate_planes else "layers"
            say_once(f"render: no fused renderer for {what}; the reference, with fused traces")
        names, planes = list(parameters), len(shown)

        def piece(i: int, *tensors: Tensor) -> Tensor:
            system = lens.system(dict(zip(names, tensors[planes:-1], strict=True)))
            system = system.traced_by(backend)
            start, end = self._chunk(i)
            now = moving.of(tensors[-1])
            ray, weight = self._samples(system, view, now.pupil, start, end)
            rim = pixel_edge_rays(system, scene, self.sensor, view, now.pupil, edges, start, end)
            shown = tensors[:planes]
            return self._shade(system, scene, view, now, shown, ray, weight, rim)

        tensors = [*shown, *parameters.values(), moving.joined(system)]
        sizes = [end - start for start, end in map(self._chunk, range(self._chunks))]
        if self.replay:
            flat = replay(piece, sizes, tensors, self._replayed(seed))
        else:
            flat = torch.cat([piece(i, *tensors) for i in range(len(sizes))], dim=-1)
        return flat.unflatten(-1, (self.sensor.height, self.sensor.width))

    def _view(
        self,
        system: OpticalSystem,
        scene: Scene,
        texture_size: tuple[int, int],
        seed: int,
        pupil: ExitPupil,
    ) -> View:
        """What does not depend on the lens's gradient: pixels, samples, pupil and planes."""
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

    @property
    def _chunks(self) -> int:
        """Number of chunks of pixels."""
        per_chunk = max(1, self.chunk_rays // self.pupil_samples**2)
        return -(-self.sensor.height * self.sensor.width // per_chunk)

    def _chunk(self, i: int) -> tuple[int, int]:
        """First pixel and end of chunk i."""
        per_chunk = max(1, self.chunk_rays // self.pupil_samples**2)
        pixels = self.sensor.height * self.sensor.width
        return i * per_chunk, min((i + 1) * per_chunk, pixels)

    def _replayed(self, seed: int) -> list[int]:
        """The chunks that the backward pass traces again."""
        count = max(1, round(self.gradient_fraction * self._chunks))
        generator = torch.Generator().manual_seed(seed % _SEED_RANGE)
        return torch.randperm(self._chunks, generator=generator)[:count].tolist()

    def _fused(
        self,
        system: OpticalSystem,
        scene: Scene,
        textures: Tensor,
        view: View,
        moving: MovingView,
    ) -> Tensor:
        """The render in one kernel."""
        wavelengths = torch.tensor(scene.wavelengths, dtype=torch.float64)
        table = pack(system, wavelengths, -1.0, 1, len(system.surfaces), False)
        pieces, scale = [(0, view.height * view.width)], 1.0
        if self.gradient_fraction < 1.0:
            replayed = self._replayed(view.seed)
            pieces = [self._chunk(i) for i in sorted(replayed)]
            scale = self._chunks / len(replayed)
        return rendering.render(
            table.values,
            table.indices,
            textures,
            system.vertices[-1],
            moving.seen_by_kernel(system, view),
            table.codes,
            table.extras,
            view.integers(),
            view.numbers(),
            torch.tensor(pieces),
            scale,
        )

    def _samples(
        self, system: OpticalSystem, view: View, pupil: ExitPupil, start: int, end: int
    ) -> tuple[Components, Tensor]:
        """Rays (pixels, samples) from the sensor, and their weights, which sum to one on axis."""
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
        ray = aim(x, y, sensor_z, disc_x * radius, disc_y * radius, pupil.z)
        return ray, (ray.n * ray.n) ** 2 * sample_share(system, view, pupil)

    def _edge_light(
        self,
        lens: Lens,
        parameters: Mapping[str, Tensor],
        scene: Scene,
        shown: tuple[Tensor, ...],
        view: View,
        moving: MovingView,
        edges: EdgeMap,
    ) -> Tensor:
        """A black image, whose gradient is that of the light at the edges of apertures."""
        names, planes = list(parameters), len(shown)
        images = shown[0].shape[0]
        per_piece = max(1, self.chunk_rays // edge_samples(self.pupil_samples))
        pixels = view.height * view.width
        starts = range(0, pixels, per_piece)
        sizes = [min(per_piece, pixels - start) for start in starts]

        def piece(i: int, *tensors: Tensor) -> Tensor:
            shape = (images, len(scene.depths), len(scene.wavelengths), sizes[i])
            system = lens.system(dict(zip(names, tensors[planes:-1], strict=True)))
            system = system.traced_by("cpu")
            now, start = moving.of(tensors[-1]), starts[i]
            rim = pixel_edge_rays(
                system, scene, self.sensor, view, now.pupil, edges, start, start + sizes[i]
            )
            if rim is None:
                return shown[0].new_zeros(shape)
            channels = [
                scene.gather(
                    tensors[:planes],
                    channel,
                    _texture_places(view, moving.still, of_channel(rim.ray, channel)),
                    rim.weight[channel],
                )
                for channel in range(len(scene.wavelengths))
            ]
            return torch.stack(channels, dim=2)

        still = [t.detach() for t in shown]
        tensors = [*still, *parameters.values(), moving.joined(lens.system(parameters))]
        return replay(piece, sizes, tensors).unflatten(-1, (view.height, view.width))

    def _shade(
        self,
        system: OpticalSystem,
        scene: Scene,
        view: View,
        moving: MovingView,
        shown: tuple[Tensor, ...],
        ray: Components,
        weight: Tensor,
        rim: EdgeRays | None,
    ) -> Tensor:
        """(B, images, C, count): trace, meet the planes, gather what they show.

        Rays of `rim` stand beside the samples.
        """
        channels = []
        for channel, wavelength in enumerate(scene.wavelengths):
            there, valid = trace_components(system, ray, wavelength, -1.0)
            arriving = torch.where(valid & (there.n < 0.0), weight, 0.0)
            if rim is not None:
                beside = of_channel(rim.ray, channel)
                there = Components(
                    *(torch.cat(pair, -1) for pair in zip(there, beside, strict=True))
                )
                arriving = torch.cat((arriving, rim.weight[channel]), -1)
            places = _texture_places(view, moving.magnifications, there)
            channels.append(scene.gather(shown, channel, places, arriving))
        return torch.stack(channels, dim=2)


def _texture_places(
    view: View, magnifications: Sequence[float | Tensor], there: Components
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and columns of the texture where rays meet one plane after the other."""
    origin = (view.texture_row, view.texture_column)
    for depth, magnification in zip(view.depths, magnifications, strict=True):
        t, _ = distance_to_plane(there, -depth, -1.0)
        x = torch.addcmul(there.x, t, there.l)
        y = torch.addcmul(there.y, t, there.m)
        yield texture_coordinates(x, y, magnification, view.pixel_pitch, origin)
