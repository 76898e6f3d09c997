"""A lens photographs a picture: what the sensor behind it gives, and what a restorer must know."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.photograph_page.page import ShownPhotograph
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.lens_camera import colours_of, distance_of, required_number
from dolens.rendering.stray_light import Light, light_on_sensor, veil
from dolens.rendering.whole_field import WholeField
from dolens.scene.planar import PlanarScene
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.display import Picture
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

# Electrons of a white pixel, at most.
_MOST_ELECTRONS = 1e9
# Rows that are read out at once; even, for a pattern of filters.
_BAND = 256


@dataclass(frozen=True, eq=False, repr=False)
class Photograph(Picture):
    """What a sensor behind a lens gives of a picture; it shows itself in a notebook.

    Attributes:
        image: (3, H, W), sRGB values from 0 to 1, blurred and noisy as the sensor has them.
        truth: likewise, without blur and noise: what an ideal lens of the same distortion, without
            lateral colour, would have imaged.
        signal: linear light before it is developed, (3, H, W), or (1, H, W) behind colour filters;
            1 is white on the axis.
        camera: the lens before the sensor, with its readout and point spread functions.
        distance: of the picture from the first vertex, mm.
    """

    signal: Tensor
    camera: "LensCamera"
    distance: float

    @property
    def noise(self) -> tuple[float, float]:
        """Return a and b: the variance of the image's light x is a·x + b."""
        return self.camera.readout.noise

    def point_spread_functions(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return the functions at pixels, by which it is restored; see `WholeField.functions`.

        Args:
            rows: (N,), pixels, with fractions or without.
            columns: (N,).

        Returns:
            (N, D, 3, K, K) at the camera's D distances, each of unit sum.
        """
        return self.camera.field.functions(rows, columns)

    def illumination(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return relative illumination at rows (N,) and columns (M,), pixels: (3, N, M)."""
        return self.camera.field.illumination(rows, columns)

    def shown(self, name: str) -> ShownPhotograph:
        """Return it as a page has it, by a name, beside its truth."""
        return ShownPhotograph(name, {"truth": self.truth, "sensor": self.image})

    def __repr__(self) -> str:
        """Return size, distance and noise as text."""
        where = "infinity" if math.isinf(self.distance) else f"{self.distance / 1000.0:g} m"
        return f"Photograph at {where}: {self.camera.description}"


@dataclass(frozen=True)
class LensCamera:
    """A lens before a sensor, which photographs pictures at D distances, each all over the sensor.

    Attributes:
        field: the lens, D planes and the pixels.
        readout: noise and colour filters.
        distances: of the planes from the first vertex, mm; infinity where the field has a plane
            far away.
        stray_light: adds lights and stray light to an image; None: nothing.
    """

    field: WholeField
    readout: Readout
    distances: tuple[float, ...]
    stray_light: "StrayLight | None" = None

    @classmethod
    def of(
        cls,
        lens: Lens,
        sensor: Sensor,
        readout: Readout | None = None,
        distances: Sequence[float] = (),
        diffraction: str | None = None,
    ) -> "LensCamera":
        """Plan how a lens's images are made.

        Args:
            lens: as it is.
            sensor: the pixels; see `lens_camera.sensor_behind`.
            readout: None: neither noise nor filters.
            distances: mm, or infinity; none: the lens's own object distance.
            diffraction: `none`, `limit` or `wave`; None: where it shows, by the model it needs.

        Raises:
            InputError: see `WholeField.of`.
        """
        distances = tuple(distances) or (float(lens.object_distance or math.inf),)
        planes = tuple(distance_of(lens, distance, sensor) for distance in distances)
        scene = PlanarScene(planes, colours_of(lens))
        field = WholeField.of(lens, scene, sensor, diffraction)
        return cls(field, Readout() if readout is None else readout, distances)

    def photographs(self, picture: Tensor, seed: int = 0) -> Iterator[Photograph]:
        """Photograph a picture at each distance, one after another.

        Args:
            picture: (3, h, w), linear light from 0 to 1; see `dolens.sensor.display`.
            seed: of the noise.

        Raises:
            InputError: the field is too wide for a plane.
        """
        texture = self.field.texture(picture)
        for number, distance in enumerate(self.distances):
            light = self.field.image(texture, number)
            if self.stray_light is not None:
                light = self.stray_light.added_to(light, self.field.imaging, number)
            signal = read_out(light, self.readout, seed)
            image = linear_to_srgb(self.readout.develop(signal))
            truth = linear_to_srgb(self.field.truth(texture, number))
            yield Photograph(image, truth, signal, self, distance)

    @property
    def description(self) -> str:
        """Return size, wavelengths and noise in words."""
        sensor, renderer, readout = self.field.sensor, self.field.renderer, self.readout
        waves = ", ".join(f"{w:.4g}" for w in self.field.imaging.scene.wavelengths)
        filters = "" if readout.pattern is None else f", filters {readout.pattern}"
        width, height = (n * sensor.pixel_pitch for n in (sensor.width, sensor.height))
        light, noise = readout.full_well, "no noise"
        if light is not None:
            read = readout.read_noise * light
            noise = f"{light:g} electrons in white, read noise {read:g}"
        return (
            f"{sensor.width}×{sensor.height} pixels of {1000.0 * sensor.pixel_pitch:.3g} µm, "
            f"{width:.3g}×{height:.3g} mm{filters}; {waves} nm; {noise}; point spread functions at "
            f"{renderer.fields[1]}×{renderer.fields[0]} places, diffraction: {renderer.diffraction}"
        )


@dataclass(frozen=True)
class StrayLight:
    """Lights and ghosts are added to images of a lens.

    Attributes:
        lens: the camera's.
        lights: in the picture.
        sensor_reflectance: share of the light that the sensor reflects.
        diffraction: whether lights have it where it shows.
        bounces: most reflections of a ghost's path, 2, 4 or 6.
    """

    lens: Lens
    lights: tuple[Light, ...]
    sensor_reflectance: float = 0.0
    diffraction: bool = True
    bounces: int = 2

    @torch.no_grad()
    def added_to(self, image: Tensor, imaging: ImagingSystem, plane: int) -> Tensor:
        """Return an image (3, H, W) in linear light with its veil, and with the lights' own images
        and ghosts.
        """
        given = (self.lens, imaging, plane)
        glare = veil(*given, self.sensor_reflectance, self.bounces).to(image)[:, None, None]
        whole = image + glare * image.mean((-2, -1), keepdim=True)
        if not self.lights:
            return whole
        found = light_on_sensor(
            *given,
            self.lights,
            sensor_reflectance=self.sensor_reflectance,
            diffraction=self.diffraction,
            bounces=self.bounces,
        )
        return whole + found.to(image)


def readout_in(light: float | None, read_noise: float, pattern: str | None = None) -> Readout:
    """Return the readout of a sensor in which white on the axis gives so many electrons a pixel.

    Args:
        light: electrons; None: no noise at all.
        read_noise: electrons, standard deviation.
        pattern: of colour filters, as `RGGB`; None: a pixel sees all three colours.

    Raises:
        InputError: a number out of range, or an unknown pattern.
    """
    if light is None:
        return Readout(pattern=pattern)
    light = required_number("light", light, _MOST_ELECTRONS, "electrons")
    read = required_number("read_noise", read_noise, _MOST_ELECTRONS, "electrons", from_zero=True)
    return Readout(full_well=light, read_noise=read / light, pattern=pattern)


def read_out(image: Tensor, readout: Readout, seed: int) -> Tensor:
    """Read an image (3, H, W) out in bands of rows, for memory: (3 or 1, H, W), as the readout
    gives it.
    """
    generator = torch.Generator(image.device).manual_seed(seed)
    channels = 3 if readout.pattern is None else 1
    signal = image if channels == 3 else image.new_empty(1, *image.shape[1:])
    for first in range(0, image.shape[1], _BAND):
        band = slice(first, first + _BAND)
        signal[:, band] = readout(image[:, band], generator)
    return signal
