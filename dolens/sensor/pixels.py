"""Pixels form a rectangular grid on the sensor plane."""

import math
from dataclasses import dataclass

from torch import Tensor

from dolens.errors import InputError

# Along one side; the largest detectors have a tenth of it.
MOST_PIXELS = 1_000_000


@dataclass(frozen=True)
class Sensor:
    """A `Sensor` is a rectangle of square pixels, centred on the axis, or a window of a larger one.

    Images are stored upright, as a viewer expects them: row 0 at the top, column 0 at the left
    of the scene as the camera sees it (looking towards -z with y up).  A lens inverts, so the
    image point (x, y) on the sensor is stored at column (W - 1)/2 - x/p - centre_column and
    row (H - 1)/2 + y/p - centre_row.

    Attributes:
        height: pixels.
        width: pixels.
        pixel_pitch: mm.
        centre_row: pixels by which the centre lies below the axis in the image.
        centre_column: pixels by which it lies right of the axis.
    """

    height: int
    width: int
    pixel_pitch: float
    centre_row: float = 0.0
    centre_column: float = 0.0

    def __post_init__(self) -> None:
        if max(self.height, self.width) > MOST_PIXELS:
            raise InputError(
                f"sensor: height and width must be at most {MOST_PIXELS} pixels, not "
                f"{self.height} and {self.width}"
            )
        if self.height < 1 or self.width < 1 or not 0.0 < self.pixel_pitch < math.inf:
            raise InputError(
                "sensor: height and width must be at least 1 pixel and pixel_pitch positive (mm), "
                f"not {self.height}, {self.width}, {self.pixel_pitch}"
            )

    def positions(self, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (x, y) in mm on the sensor plane from fractional pixel coordinates."""
        x = (0.5 * (self.width - 1) - self.centre_column - columns) * self.pixel_pitch
        y = (rows - (0.5 * (self.height - 1) - self.centre_row)) * self.pixel_pitch
        return x, y

    def pixels(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return fractional rows and columns of points on the sensor plane, mm; the inverse of
        `positions`.
        """
        rows = 0.5 * (self.height - 1) - self.centre_row + y / self.pixel_pitch
        columns = 0.5 * (self.width - 1) - self.centre_column - x / self.pixel_pitch
        return rows, columns

    def window(self, top: int, left: int, height: int, width: int) -> "Sensor":
        """Return the pixels from row `top` and column `left` on, as a sensor of its own.

        Raises:
            InputError: the window is not within the sensor.
        """
        if top < 0 or left < 0 or top + height > self.height or left + width > self.width:
            raise InputError(
                f"sensor: a window of {height}×{width} pixels at row {top}, column {left} is not "
                f"within {self.height}×{self.width} pixels"
            )
        return Sensor(
            height,
            width,
            self.pixel_pitch,
            self.centre_row + top + 0.5 * (height - self.height),
            self.centre_column + left + 0.5 * (width - self.width),
        )
