"""Images of point sources: measured, read from photographs, or simulated photon by photon."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.alignment.unmodelled import Unmodelled, diffracted_light, on_disc
from dolens.errors import InputError
from dolens.optics.elements import Axes, from_lens_axes, points_to_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays
from dolens.rendering.spot_image import SpotImage
from dolens.sensor.image_files import MEGAPIXELS, read_numbers
from dolens.sensor.pixels import Sensor
from dolens.typed_values import call_with_settings, check_type

_AT_A_TIME = 1 << 20
_IN_CACHE = 1 << 14
# Of directions that are drawn, about a third pass.
_DRAWN = 4
# Of the light behind the lens; with less on the pixels, their shares mean nothing.
_LEAST_SEEN = 0.01
# Light may pass the first rim of a tilted, curved surface that far out in its vertex plane.
_REACH = 1.4


@dataclass(frozen=True)
class Measurement:
    """Holds S images, one of each source, or of some sources on several planes.

    Attributes:
        images: (S, height, width), electrons, the dark level taken off.
        mask: (S, height, width), where they can be trusted.
        read_noise: RMS, electrons.
        sensor: the pixels.
    """

    images: Tensor
    mask: Tensor
    read_noise: float
    sensor: Sensor

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        """Take the fields alone to another process: what is cached within a derivative
        (`torch.func.jvp`) cannot be stored.
        """
        return type(self), tuple(getattr(self, each.name) for each in fields(self))

    @cached_property
    def totals(self) -> Tensor:
        """Return the electrons (S,) in trusted pixels."""
        return torch.where(self.mask, self.images, 0.0).sum((-2, -1))

    @cached_property
    def shares(self) -> Tensor:
        """Return the images (S, height, width), scaled to a sum of 1 over the trusted pixels."""
        return torch.where(self.mask, self.images, 0.0) / self.totals[:, None, None]

    @cached_property
    def lit_pixels(self) -> Tensor:
        """Return how many pixels each image covers (S,): 1/Σ share², their number if all were
        alike.
        """
        return 1.0 / self.shares.square().sum((-2, -1))

    def centroids(self) -> Tensor:
        """Return the centroids (S, 2), x and y, mm, of trusted pixels."""
        return torch.stack([self.centroid_of(share) for share in self.shares])

    def as_seen(self, found: SpotImage, source: int) -> tuple[Tensor, Tensor]:
        """Return a model's image as the measured one is: shares (height, width) of the light on
        trusted pixels, and their centroid (2,), mm.

        Where less than a hundredth of the light falls on them, both are of all light behind the
        lens, so that they lead back from anywhere.
        """
        image, centroid = torch.where(self.mask[source], found.image, 0.0), found.centroid
        seen = image.sum()
        if float(seen.detach()) > _LEAST_SEEN:
            image = image / seen
            centroid = self.centroid_of(image)
        return image, centroid

    def centroid_of(self, share: Tensor) -> Tensor:
        """Return the centroid (2,), x and y, mm, of an image (height, width) of sum 1."""
        options: dict[str, Any] = {"dtype": share.dtype, "device": share.device}
        rows = torch.arange(self.sensor.height, **options)
        columns = torch.arange(self.sensor.width, **options)
        x, y = self.sensor.positions(rows, columns)
        return torch.stack([(share.sum(0) * x).sum(), (share.sum(1) * y).sum()])


@dataclass(frozen=True)
class Light:
    """Describes light and noise of simulated measurements.

    Attributes:
        photons: of each image, behind the lens; those beyond the sensor's edge are among them.
        read_noise: RMS of a pixel, electrons.
        full_well: electrons at which a pixel saturates; None: never.
        unmodelled: what a measurement has and the model of a fit has not.

    Raises:
        InputError: a number out of range.
    """

    photons: float = 4_000_000
    read_noise: float = 2.0
    full_well: float | None = None
    unmodelled: Unmodelled = field(default_factory=Unmodelled)

    def __post_init__(self) -> None:
        for name, least in (("photons", 1.0), ("read_noise", 0.0)):
            if not least <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: {getattr(self, name)}; allowed: {least:g} or more")


@torch.no_grad()
def simulated(
    lens: Lens,
    sources: Tensor,
    wavelength: float,
    sensor: Sensor,
    light: Light,
    generator: torch.Generator,
    planes: Sequence[float] = (0.0,),
) -> Measurement:
    """Simulate images: photons leave each source in random directions and are counted where they
    arrive.

    Rims are sharp, pixels are squares that count, and nothing is smoothed.

    Args:
        lens: as it stands, with the radii and indices that it truly has.
        sources: (S, 3), mm.
        wavelength: nm.
        sensor: the pixels.
        light: of each image; pixels that it saturates are not trusted.  The lens has its errors
            of radius and index already.
        generator: of directions and noise.

    Rarely needed:
        planes: where the sensor stands, mm from where the lens has it; an exposure of each source
            on each.

    Raises:
        InputError: no light passes.
    """
    effects, photons = light.unmodelled, int(light.photons)
    diameter = effects.source_diameter
    images = []
    moved = [lens.storing_its_values() for _ in planes]
    for one, plane in zip(moved, planes, strict=True):
        one.sensor_distance.add_(plane)
    for source, one in itertools.product(sources.double(), moved):
        image = torch.zeros(sensor.height * sensor.width, dtype=torch.float64)
        if effects.diffraction:
            fine = diffracted_light(one, source, wavelength, sensor, diameter)
            places = iter([fine.photons(photons, diameter, generator)])
        else:
            places = _by_rays(one, source, wavelength, photons, diameter, generator)
        for x, y in places:
            rows, columns = (p.round() for p in sensor.pixels(x, y))
            inside = (
                (rows >= 0) & (rows < sensor.height) & (columns >= 0) & (columns < sensor.width)
            )
            place = (rows * sensor.width + columns)[inside].long()
            image += torch.bincount(place, minlength=len(image))
        if effects.background > 0.0:
            image += torch.poisson(torch.full_like(image, effects.background), generator)
        noise = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        images.append((image + light.read_noise * noise).reshape(sensor.height, sensor.width))
    stacked = torch.stack(images)
    mask = torch.ones_like(stacked, dtype=torch.bool)
    if light.full_well is not None:
        mask = stacked < light.full_well
    return Measurement(stacked, mask, light.read_noise, sensor)


def _by_rays(
    lens: Lens,
    source: Tensor,
    wavelength: float,
    photons: int,
    source_diameter: float,
    generator: torch.Generator,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the places where photons arrive, x and y in mm, some at a time."""
    passed = 0
    while passed < photons:
        count = min(_AT_A_TIME, _DRAWN * (photons - passed) + 1024)
        rays = _directions(lens, source, wavelength, count, source_diameter, generator)
        hit = trace_rays(lens.system(), rays)
        x, y = (c[hit.valid].double() for c in hit.position[:, :2].unbind(-1))
        if not len(x):
            raise InputError("no light from the source reaches the sensor plane")
        x, y = x[: photons - passed], y[: photons - passed]
        passed += len(x)
        yield x, y


def _directions(
    lens: Lens,
    source: Tensor,
    wavelength: float,
    count: int,
    source_diameter: float,
    generator: torch.Generator,
) -> Rays:
    """Return at most so many rays of even density in solid angle, towards the first surface as it
    is.
    """
    system = lens.system()
    axes = system.axes[0]
    radius = _REACH * system.surfaces[0].semi_diameter
    drawn = torch.rand(3, count, generator=generator, dtype=torch.float64)
    start = source.expand(count, 3)
    if source_diameter > 0.0:
        u, v = torch.rand(2, count, generator=generator, dtype=torch.float64)
        across = on_disc(u, v, 0.5 * source_diameter)
        start = source + torch.stack([*across, torch.zeros_like(u)], -1)
    # Parts that fit into a processor's cache take less time than all at once.
    parts = zip(drawn.split(_IN_CACHE, 1), start.split(_IN_CACHE), strict=True)
    found = [_aimed(axes, radius, u, v, begun) for (u, v, _), begun in parts]
    d, density = (torch.cat(part) for part in zip(*found, strict=True))
    chosen = drawn[2] * density.max() < density
    return Rays(start[chosen], d[chosen], wavelength)


def _aimed(axes: Axes, radius: float, u: Tensor, v: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Return rays' directions to points of even density on a disc in a surface's vertex plane.

    The directions are unit vectors (N, 3) from points (N, 3); beside them stands how much solid
    angle a part of the disc's area takes (N,).
    """
    x, y = on_disc(u, v, radius)
    local = x, y, torch.zeros_like(x)
    d = torch.stack(points_to_lens_axes(local, axes), -1) - start
    distance = d.norm(dim=-1)
    d = d / distance[:, None]
    cosine = from_lens_axes(Components(*local, *d.unbind(-1)), axes).n
    return d, cosine / distance**2


def read_measurements(
    settings: Mapping[str, Any] | Sequence[Mapping[str, Any]], count: int
) -> Measurement:
    """Read one photograph, or several, of each source on each plane, by one sensor.

    Args:
        settings: of `read_measurement`, or a list of such.
        count: of photographs that are wanted.

    Raises:
        InputError: another count, or photographs whose pixels or read noise differ.
    """
    check_type(settings, Mapping[str, Any] | Sequence[Mapping[str, Any]], "measurement")
    entries = [settings] if isinstance(settings, Mapping) else list(settings)
    if len(entries) != count:
        raise InputError(
            f"measurement: {len(entries)} photographs; allowed: {count}, one of each source on "
            "each plane"
        )
    read = [call_with_settings(read_measurement, entry, "measurement") for entry in entries]
    if any((each.sensor, each.read_noise) != (read[0].sensor, read[0].read_noise) for each in read):
        raise InputError("measurement: photographs differ in their pixels or in their read noise")
    return replace(
        read[0],
        images=torch.cat([each.images for each in read]),
        mask=torch.cat([each.mask for each in read]),
    )


def read_measurement(
    path: str | Path,
    pixel_pitch: float,
    dark_level: float = 0.0,
    region: tuple[int, int, int, int] | None = None,
    downsample: int = 1,
    saturation: float | None = None,
    electrons_per_count: float = 1.0,
    read_noise: float = 1.0,
    megapixels: float = MEGAPIXELS,
) -> Measurement:
    """Read a photograph of a source, 16 bits or 8, of one channel.

    Args:
        path: TIFF or PNG.
        pixel_pitch: of the photograph, mm.
        dark_level: counts that the sensor gives in the dark.

    Rarely needed:
        region: top, left, height and width that are used, pixels; None: all.  The optical axis is
            taken to meet the middle of the photograph.
        downsample: pixels along each side that are averaged to one; those that are left over at the
            right and at the bottom are cut off.
        saturation: counts from which a pixel is not trusted; None: the largest that the file's
            integers can hold.
        electrons_per_count: of the sensor.
        read_noise: RMS of one pixel, electrons.
        megapixels: the largest photograph that is read, millions of pixels.

    Raises:
        InputError: the file cannot be read, is not grey integers, or a number is out of range.
    """
    try:
        values = read_numbers(Path(path).expanduser(), ("PNG", "TIFF"), megapixels)
    except InputError as error:
        raise InputError(f"measurement: {error.whole}") from error
    if values.ndim != 2 or values.dtype.kind not in "ui":
        raise InputError(
            f"measurement: {path} has {values.dtype} of shape {values.shape}; allowed: one "
            "channel of integers"
        )
    if downsample < 1 or not 0.0 < pixel_pitch < math.inf:
        raise InputError(
            f"measurement: downsample {downsample} and pixel_pitch {pixel_pitch}; allowed: 1 or "
            "more, and above 0 (mm)"
        )
    if not 0.0 <= read_noise < math.inf:
        raise InputError(f"measurement.read_noise: {read_noise}; allowed: 0 or more")
    if not 0.0 < electrons_per_count < math.inf:
        raise InputError(
            f"measurement.electrons_per_count: {electrons_per_count}; allowed: above 0"
        )
    if saturation is None:
        saturation = float(np.iinfo(values.dtype).max)
    counts = torch.from_numpy(values.astype(np.float64))
    whole = Sensor(counts.shape[0], counts.shape[1], pixel_pitch)
    top, left, height, width = region or (0, 0, whole.height, whole.width)
    height, width = height - height % downsample, width - width % downsample
    window = whole.window(top, left, height, width)
    counts = counts[top : top + height, left : left + width]

    def blocks(t: Tensor) -> Tensor:
        return t.unflatten(1, (-1, downsample)).unflatten(0, (-1, downsample))

    trusted = blocks(counts < saturation).all(-1).all(1)
    electrons = blocks((counts - dark_level) * electrons_per_count).sum((1, 3))
    sensor = Sensor(
        height // downsample,
        width // downsample,
        pixel_pitch * downsample,
        window.centre_row / downsample,
        window.centre_column / downsample,
    )
    return Measurement(electrons[None], trusted[None], read_noise * downsample, sensor)
