"""A view is a sensor's pixels, their samples of the pupil, and planes of a scene."""

from dataclasses import dataclass


@dataclass(frozen=True)
class View:
    """A sensor looks through a lens at textured planes.

    Attributes:
        height: pixels.
        width: pixels.
        pixel_pitch: mm.
        pupil_samples: strata along each side of the pupil.
        pixel_area: whether samples fill the pixel's area, or start from its centre.
        seed: of the samples; its 64 lowest bits count.
        middle_row: row of the image where the axis is; the middle one but for windows.
        middle_column: its column.
        texture_row: row of the texture where the axis is.
        texture_column: its column.
        pupil_z: of the exit pupil's disc, mm from the first vertex.
        pupil_radius: of the disc that is sampled, mm.
        axial_radius: of the disc that axial pixels see filled with light, mm.
        depths: of the planes, mm in front of the first vertex.
        magnifications: of the planes; a texel covers pixel_pitch / magnification.
    """

    height: int
    width: int
    pixel_pitch: float
    pupil_samples: int
    pixel_area: bool
    seed: int
    middle_row: float
    middle_column: float
    texture_row: float
    texture_column: float
    pupil_z: float
    pupil_radius: float
    axial_radius: float
    depths: tuple[float, ...]
    magnifications: tuple[float, ...]

    def weight(self, sensor_z: float) -> float:
        """Return the weight of a sample over cos⁴ of its ray's angle, so that they sum to one on
        the axis.

        The mean of cos⁴ over a disc of radius a at distance L, seen from the axis, is L²/(L² + a²).
        """
        squared = (sensor_z - self.pupil_z) ** 2
        axial = squared / (squared + self.axial_radius**2)
        larger = (self.pupil_radius / self.axial_radius) ** 2
        return larger / (axial * self.pupil_samples**2)

    def integers(self) -> list[int]:
        """Return the integers, as an operator takes them; `from_lists` is the inverse."""
        return [
            self.height,
            self.width,
            self.pupil_samples,
            int(self.pixel_area),
            self.seed & 0xFFFFFFFF,
            (self.seed >> 32) & 0xFFFFFFFF,
        ]

    def numbers(self) -> list[float]:
        """Return the lengths and magnifications, as an operator takes them."""
        own = (
            self.pixel_pitch,
            self.middle_row,
            self.middle_column,
            self.texture_row,
            self.texture_column,
            self.pupil_z,
            self.pupil_radius,
            self.axial_radius,
        )
        return [*own, *self.depths, *self.magnifications]

    @staticmethod
    def from_lists(integers: list[int], numbers: list[float]) -> "View":
        """Return the view of `integers` and `numbers`."""
        height, width, pupil_samples, pixel_area, low, high = integers
        pixel_pitch, row, column, of_row, of_column, pupil_z, pupil_radius, axial_radius = numbers[
            :8
        ]
        planes = numbers[8:]
        depths = len(planes) // 2
        return View(
            height,
            width,
            pixel_pitch,
            pupil_samples,
            bool(pixel_area),
            low + (high << 32),
            row,
            column,
            of_row,
            of_column,
            pupil_z,
            pupil_radius,
            axial_radius,
            tuple(planes[:depths]),
            tuple(planes[depths:]),
        )
