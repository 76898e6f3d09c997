"""Backward-mode rendering: from pixels through the exit pupil and the lens to textured planes."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.pupil import ExitPupil, aim, axial_exit_pupil
from dolens.imaging.replay import replay
from dolens.imaging.sampling import square_to_disc, stratified_square
from dolens.imaging.scene import PlanarScene, texture_coordinates
from dolens.imaging.sensor import Sensor
from dolens.imaging.texture import bilinear
from dolens.optics.lens import Lens
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import distance_to_plane, trace_surfaces

# Two large primes give every (seed, piece) its own stream without shared state.
_SEED_FACTOR, _PIECE_FACTOR, _SEED_RANGE = 1_000_000_007, 998_244_353, 2**63 - 1


@dataclass(frozen=True)
class RayRenderer:
    """Monte Carlo rendering: jittered points of each pixel, a stratified sampling of the pupil.

    Each pixel sends `pupil_samples`² rays: one from a random point of the pixel through a random
    point of each stratum of the exit pupil.  All wavelengths share the samples.  The irradiance
    of a pixel is the mean over the pupil of radiance · cos⁴, relative to the axis, so that a white
    plane renders white on the axis and falls off where the lens does.

    Attributes:
        sensor: the pixels.
        pupil_samples: strata along each side; rays a pixel are its square.
        chunk_rays: rays traced at a time; sets the memory, not the result's distribution.
        replay: recompute each chunk in the backward pass, so that memory stays bounded.
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

    def rays_per_image(self, scene: PlanarScene) -> int:
        """Rays traced through the lens for one render, all wavelengths together."""
        pixels = self.sensor.height * self.sensor.width
        return pixels * self.pupil_samples**2 * len(scene.wavelengths)

    def render(
        self,
        lens: Lens,
        scene: PlanarScene,
        textures: Tensor,
        seed: int,
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Image textures at every depth of a scene.

        Args:
            lens: the lens; its precision is the rays'.
            scene: depths and wavelengths.
            textures: (B, C, H, W), linear light, a channel for each wavelength.
            seed: the same seed gives the same samples, whatever ran before.
            values: lens parameters to use instead of the stored ones.

        Returns:
            (B, depths, C, height, width), linear light, in the lens's precision.  Differentiable
            in the lens's parameters, `values` and the textures.

        Raises:
            InputError: a depth inside the lens, or channels that do not match the wavelengths.
        """
        if textures.dim() != 4 or textures.shape[1] != len(scene.wavelengths):
            raise InputError(
                f"textures must be (B, {len(scene.wavelengths)}, H, W), one channel a wavelength, "
                f"not {tuple(textures.shape)}"
            )
        stored = {n: p for n, p in lens.named_parameters() if p.requires_grad}
        parameters = {**stored, **(values or {})}
        names = list(parameters)
        now = lens.system({n: p.detach() for n, p in parameters.items()})
        scene.check(now)
        pupil = axial_exit_pupil(now, scene.wavelengths)
        magnifications = scene.magnifications(now)
        pixels = self.sensor.height * self.sensor.width
        per_chunk = max(1, self.chunk_rays // self.pupil_samples**2)
        starts = list(range(0, pixels, per_chunk))
        sizes = [min(per_chunk, pixels - start) for start in starts]

        def piece(i: int, textures: Tensor, *tensors: Tensor) -> Tensor:
            system = lens.system(dict(zip(names, tensors, strict=True)))
            samples = self._samples(system, pupil, starts[i], sizes[i], seed, i)
            return self._shade(system, scene, textures, magnifications, *samples)

        tensors = [textures.to(device=lens.device, dtype=lens.dtype), *parameters.values()]
        if self.replay:
            count = max(1, round(self.gradient_fraction * len(sizes)))
            generator = torch.Generator().manual_seed(seed % _SEED_RANGE)
            replayed = torch.randperm(len(sizes), generator=generator)[:count].tolist()
            flat = replay(piece, sizes, tensors, replayed)
        else:
            flat = torch.cat([piece(i, *tensors) for i in range(len(sizes))], dim=-1)
        return flat.unflatten(-1, (self.sensor.height, self.sensor.width))

    def _samples(
        self,
        system: OpticalSystem,
        pupil: ExitPupil,
        start: int,
        count: int,
        seed: int,
        index: int,
    ) -> tuple[Components, Tensor]:
        """Rays (count, samples) from the sensor, and their weights, which sum to one on axis."""
        number = (seed * _SEED_FACTOR + index * _PIECE_FACTOR) % _SEED_RANGE
        generator = torch.Generator(system.device).manual_seed(number)
        u, v = stratified_square(self.pupil_samples, count, generator, system.dtype)
        disc_x, disc_y = square_to_disc(u, v)
        pixel = torch.arange(start, start + count, device=system.device)[:, None]
        rows = torch.div(pixel, self.sensor.width, rounding_mode="floor").to(system.dtype)
        columns = (pixel % self.sensor.width).to(system.dtype)
        if self.pixel_area:
            options = {"generator": generator, "dtype": system.dtype, "device": system.device}
            jitter = torch.rand((2, *u.shape), **options) - 0.5
            rows, columns = rows + jitter[0], columns + jitter[1]
        x, y = self.sensor.positions(rows, columns)
        sensor_z = system.vertices[-1]
        ray = aim(x, y, sensor_z, disc_x * pupil.radius, disc_y * pupil.radius, pupil.z)
        # cos⁴ of the ray's angle, relative to its mean over the disc seen from the axis, which is
        # L²/(L² + a²) for a disc of radius a at distance L.
        squared = ((sensor_z - pupil.z) ** 2).detach()
        axial = squared / (squared + pupil.radius**2)
        return ray, (ray.n * ray.n) ** 2 / (axial * self.pupil_samples**2)

    def _shade(
        self,
        system: OpticalSystem,
        scene: PlanarScene,
        textures: Tensor,
        magnifications: list[float],
        ray: Components,
        weight: Tensor,
    ) -> Tensor:
        """(B, depths, C, count): trace, meet each plane, look the texture up, sum the samples."""
        size = (textures.shape[-2], textures.shape[-1])
        channels = []
        for channel, wavelength in enumerate(scene.wavelengths):
            traced = trace_surfaces(system, ray, wavelength, sense=-1.0)
            arriving = torch.where(traced.valid & (traced.ray.n < 0.0), weight, 0.0)
            by_depth = []
            for depth, magnification in zip(scene.depths, magnifications, strict=True):
                t, _ = distance_to_plane(traced.ray, -depth, -1.0)
                x = torch.addcmul(traced.ray.x, t, traced.ray.l)
                y = torch.addcmul(traced.ray.y, t, traced.ray.m)
                rows, columns = texture_coordinates(x, y, magnification, self.sensor, size)
                radiance = bilinear(textures[:, channel], rows, columns)
                by_depth.append((radiance * arriving).sum(dim=-1))
            channels.append(torch.stack(by_depth, dim=1))
        return torch.stack(channels, dim=2)
