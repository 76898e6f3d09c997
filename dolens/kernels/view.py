"""What a renderer renders: a sensor's pixels, their samples of the pupil, and planes of a scene."""

from dataclasses import dataclass


@dataclass(frozen=True)
class View:
    """A sensor that looks through a lens at textured planes.

    Attributes:
        height: pixels.
        width: pixels.
        pixel_pitch: mm.
        pupil_samples: strata along each side of the pupil.
        pixel_area: whether samples fill the pixel's area, or start from its centre.
        seed: of the samples; its 64 lowest bits count.
        pupil_z: of the exit pupil's disc, mm from the first vertex.
        pupil_radius: mm.
        depths: of the planes, mm in front of the first vertex.
        magnifications: of the planes; a texel covers pixel_pitch / magnification.
    """

    height: int
    width: int
    pixel_pitch: float
    pupil_samples: int
    pixel_area: bool
    seed: int
    pupil_z: float
    pupil_radius: float
    depths: tuple[float, ...]
    magnifications: tuple[float, ...]

    def weight(self, sensor_z: float) -> float:
        """Weight of a sample over cos⁴ of its ray's angle, so that they sum to one on the axis.

        The mean of cos⁴ over a disc of radius a at distance L, seen from the axis, is L²/(L² + a²).
        """
        squared = (sensor_z - self.pupil_z) ** 2
        axial = squared / (squared + self.pupil_radius**2)
        return 1.0 / (axial * self.pupil_samples**2)

    def integers(self) -> list[int]:
        """The integers, as an operator takes them; `from_lists` is the inverse."""
        return [
            self.height,
            self.width,
            self.pupil_samples,
            int(self.pixel_area),
            self.seed & 0xFFFFFFFF,
            (self.seed >> 32) & 0xFFFFFFFF,
        ]

    def numbers(self) -> list[float]:
        """The lengths and magnifications, as an operator takes them."""
        own = (self.pixel_pitch, self.pupil_z, self.pupil_radius)
        return [*own, *self.depths, *self.magnifications]

    @staticmethod
    def from_lists(integers: list[int], numbers: list[float]) -> "View":
        """The view of `integers` and `numbers`."""
        height, width, pupil_samples, pixel_area, low, high = integers
        pixel_pitch, pupil_z, pupil_radius, *planes = numbers
        depths = len(planes) // 2
        return View(
            height,
            width,
            pixel_pitch,
            pupil_samples,
            bool(pixel_area),
            low + (high << 32),
            pupil_z,
            pupil_radius,
            tuple(planes[:depths]),
            tuple(planes[depths:]),
        )
