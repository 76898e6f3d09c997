"""Field points: where in the object the light of an analysis comes from."""

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor


class Fields(NamedTuple):
    """Field points of a lens.

    Attributes:
        kind: `angles`, in degrees, of an object at any distance: a ray from field (x, y) has
            direction (tan x, tan y, 1) normalised; or `heights`, in mm, of points of an object
            plane at a finite distance.
        points: (x, y) of each.
    """

    kind: str
    points: tuple[tuple[float, float], ...]


def point_text(point: Sequence[float] | Tensor, digits: int = 6) -> str:
    """Return a point (x, y) as text: `-14`, or `(3, -14)` beside the y-z plane.

    Args:
        point: x and y.
        digits: significant digits.
    """
    # Adding zero leaves no negative zero.
    x, y = (f"{float(value) + 0.0:.{digits}g}" for value in point)
    return y if x == "0" else f"({x}, {y})"


def field_label(point: Sequence[float] | Tensor, unit: str) -> str:
    """Return a field as a figure or a table shows it: `14°`, `(3, 14)°`, `−2 mm`.

    Args:
        point: x and y.
        unit: `°` or `mm`.
    """
    space = "" if unit == "°" else " "
    return f"{point_text(point)}{space}{unit}".replace("-", "−")
