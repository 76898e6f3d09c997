"""The pixel grid."""

from dataclasses import dataclass

from torch import Tensor

from dolens.errors import InputError


@dataclass(frozen=True)
class Sensor:
    """A rectangle of square pixels, centred on the axis.

    Images are stored upright, as a viewer expects them: row 0 at the top, column 0 at the left
    of the scene as the camera sees it (looking towards -z with y up).  A lens inverts, so the
    image point (x, y) on the sensor is stored at column (W - 1)/2 - x/p and row (H - 1)/2 + y/p.

    Attributes:
        height: pixels.
        width: pixels.
        pixel_pitch: mm.
    """

    height: int
    width: int
    pixel_pitch: float

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1 or not self.pixel_pitch > 0.0:
            raise InputError(
                "sensor: height and width must be at least 1 pixel and pixel_pitch positive (mm), "
                f"not {self.height}, {self.width}, {self.pixel_pitch}"
            )

    def positions(self, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Points (x, y) in mm on the sensor plane of fractional pixel coordinates."""
        x = (0.5 * (self.width - 1) - columns) * self.pixel_pitch
        y = (rows - 0.5 * (self.height - 1)) * self.pixel_pitch
        return x, y
