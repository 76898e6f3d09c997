"""Images of point sources through a lens, by rays traced forward onto pixels.

The lens may stand anywhere, tilted too: rays aim at its first surface where that is, so that as the
lens moves its light moves with it, smoothly.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes, points_from_lens_axes, points_to_lens_axes
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem, require_plane_sensor, require_refracting
from dolens.optics.trace import Trace, trace_surfaces, trace_to_sensor
from dolens.rendering.psf import bin_rays
from dolens.sensor.pixels import Sensor

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


class SensorIntercepts(NamedTuple):
    """Intercepts of rays with the sensor plane, mm, and the light of each, steradians; (N,)."""

    x: Tensor
    y: Tensor
    light: Tensor


class SpotImage(NamedTuple):
    """A source's image.

    Attributes:
        image: (height, width), the share of the light behind the lens that each pixel gets.
        centroid: (2,), x and y of all of that light, mm, on the sensor or beyond it.
        flux: light behind the lens, steradians seen from the source.
    """

    image: Tensor
    centroid: Tensor
    flux: Tensor


@dataclass(frozen=True)
class SpotImager:
    """Images point sources by rays traced forward.

    Light fades from whole to none over a narrow band about every rim, half of it inside: an edge
    that is sharp would have rays come and go, which derivatives do not see.  It moves the light's
    moments by no more than the square of the band's relative width.

    Attributes:
        sensor: the pixels.
        wavelength: nm.
        rays: for each source.
        rim: width of that band over the rim's semi-diameter.
        reach: radius of the disc that rays aim at, in the vertex plane of the first surface, over
            its semi-diameter; more than 1, since oblique rays that pass the rim of a curved surface
            cross its vertex plane farther out.
        subpixels: along each side of a pixel; see `bin_rays`.
        seed: turns the pattern of rays.
        rays_at_a_time: bounds memory.
        subpixels_of: of each image of a series, in the place of `subpixels`; see `for_image`.

    Raises:
        InputError: a number out of range.
    """

    sensor: Sensor
    wavelength: float
    rays: int = 100_000
    rim: float = 0.01
    reach: float = 1.25
    subpixels: int = 2
    seed: int = 0
    rays_at_a_time: int = 1 << 17
    subpixels_of: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        for name, low in (("rays", 1), ("subpixels", 1), ("rays_at_a_time", 1)):
            if getattr(self, name) < low:
                raise InputError(f"imager.{name}: {getattr(self, name)}; allowed: {low} or more")
        if not 0.0 < self.rim < 1.0:
            raise InputError(f"imager.rim: {self.rim}; allowed: above 0 and below 1")
        if not self.reach > 1.0:
            raise InputError(f"imager.reach: {self.reach}; allowed: above 1")

    def for_image(self, number: int) -> "SpotImager":
        """Return what makes one image of a series, with patches of its own.

        The same rays are dense in an image near focus, and far apart in one that is defocused.
        """
        if self.subpixels_of is None:
            return self
        return replace(self, subpixels=self.subpixels_of[number], subpixels_of=None)

    def image(self, system: OpticalSystem, source: Tensor) -> SpotImage:
        """The image of a point source.

        Memory does not grow with the number of rays, gradients included: parts of them are traced
        anew for these.  Forward-mode derivatives (`torch.func.jvp`) work as well.

        Args:
            system: the lens, in double precision for derivatives worth trusting.
            source: (3,), mm, in the lens's axes; in front of the lens.

        Raises:
            InputError: the lens has mirrors or coordinate breaks, no light reaches the sensor
                plane, or some passes the rim of the disc that
                rays aim at.
        """
        require_refracting(system, "images of point sources")
        require_plane_sensor(system, "images of point sources")
        options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
        grid = torch.zeros(self.sensor.height, self.sensor.width, **options)
        sums = torch.zeros(3, **options)
        for first in range(0, self.rays, self.rays_at_a_time):
            last = min(first + self.rays_at_a_time, self.rays)
            # Forward mode keeps nothing for a way back, and PyTorch 2.9 cannot pass a checkpoint.
            backward = torch.is_grad_enabled() and forward_ad._current_level < 0
            if backward and last - first < self.rays:
                part = checkpoint(self._part, system, source, first, last, use_reentrant=False)
            else:
                part = self._part(system, source, first, last)
            grid, sums = grid + part[0], sums + part[1]
        if not float(sums[0].detach()) > 0.0:
            raise InputError("no light from the source reaches the sensor plane")
        return SpotImage(grid / sums[0], sums[1:] / sums[0], sums[0])

    def _part(
        self, system: OpticalSystem, source: Tensor, first: int, last: int
    ) -> tuple[Tensor, Tensor]:
        """Pixels, and Σ light·(1, x, y), of rays `first` to `last`."""
        landed = self.sensor_intercepts(system, source, first, last)
        sensor = self.sensor
        rows, columns = sensor.pixels(landed.x, landed.y)
        grid = bin_rays(rows, columns, landed.light, sensor.height, sensor.width, self.subpixels)
        light = landed.light
        return grid, torch.stack([light.sum(), (light * landed.x).sum(), (light * landed.y).sum()])

    def sensor_intercepts(
        self, system: OpticalSystem, source: Tensor, first: int = 0, last: int | None = None
    ) -> SensorIntercepts:
        """Rays `first` to `last` of a source on the sensor plane.

        Each carries the solid angle of its part of the disc that it aims at, cos θ·dA/r².
        """
        semi_diameter = system.surfaces[0].semi_diameter
        u, v = self._disc(first, self.rays if last is None else last, system)
        radius = self.reach * semi_diameter
        area = math.pi * radius**2 / self.rays
        axes = system.axes[0]
        to = points_to_lens_axes((radius * u, radius * v, torch.zeros_like(u)), axes)
        d = [t - s for t, s in zip(to, source.to(u).unbind(), strict=True)]
        distance = torch.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
        l, m, n = (c / distance for c in d)  # noqa: E741
        ray = Components(*to, l, m, n)
        cosine = from_lens_axes(ray, axes).n
        trace = trace_surfaces(system, ray, self.wavelength, record=True)
        light = area * cosine / distance**2 * self._passed(system, trace, u * u + v * v)
        on_sensor = trace_to_sensor(system, trace, self.wavelength)
        return SensorIntercepts(on_sensor.ray.x, on_sensor.ray.y, light)

    def _passed(self, system: OpticalSystem, trace: Trace, aimed: Tensor) -> Tensor:
        """The share of each ray that the rims let through.

        Args:
            system: the lens.
            trace: of rays through it, with the points where they met its surfaces.
            aimed: squares of the rays' distances from the axis in the disc that they aim at.
        """
        share, goes_on = torch.ones_like(aimed), torch.ones_like(aimed, dtype=torch.bool)
        for surface, axes, point, margins in zip(
            system.surfaces, system.axes, trace.points, trace.margins, strict=True
        ):
            x, y, _ = points_from_lens_axes(point, axes)
            depth = surface.aperture.depth(x, y) / (self.rim * surface.semi_diameter)
            step = (depth + 0.5).clamp(0.0, 1.0)
            share = share * step * step * (3.0 - 2.0 * step)
            for margin in (margins.met, margins.transmitted):
                if margin is not None:
                    goes_on = goes_on & (margin > 0.0)
        share = torch.where(goes_on, share, 0.0)
        beyond = (aimed > 0.98) & (share.detach() > 0.0)
        if bool(beyond.any()):
            raise InputError(
                f"imager.reach: light passes the lens beyond {self.reach:g} semi-diameters of its "
                "first surface's vertex plane; a larger number is needed"
            )
        return share

    def _disc(self, first: int, last: int, system: OpticalSystem) -> tuple[Tensor, Tensor]:
        """Points of a sunflower in the unit disc: each has the same area, and few are in line."""
        number = torch.arange(first, last, dtype=torch.float64, device=system.device)
        radius = torch.sqrt((number + 0.5) / self.rays)
        # The seeds' turns lie apart by an irrational part of a whole one.
        angle = number * _GOLDEN_ANGLE + self.seed * 2.0 * math.pi * (math.sqrt(2.0) - 1.0)
        return (radius * torch.cos(angle)).to(system.dtype), (radius * torch.sin(angle)).to(
            system.dtype
        )
