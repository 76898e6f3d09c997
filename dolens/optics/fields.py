"""Field points: where in the object the light of an analysis comes from."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError

# Light so near 90° to the axis, degrees, is traced as light from the side is: it crosses a vertex
# plane hundreds of semi-diameters away.
_STEEP = 89.0
# Fields this near to each other, in their own unit, are the same.
_SAME = 1e-9


class Vignetting(NamedTuple):
    """The beam of a field fills an ellipse of the stop, as a designer's vignetting factors say it.

    Of the coordinates over the stop's semi-diameter, (x, y) goes to the point
    (decenter_x + (1 - compression_x)·x, decenter_y + (1 - compression_y)·y), turned by the angle
    from x to y; so all zeros are the whole stop.

    Attributes:
        decenter_x: over the semi-diameter of the stop.
        decenter_y: likewise.
        compression_x: the share of the half-width that is cut off; negative, of a wider beam.
        compression_y: likewise.
        angle: degrees.
    """

    decenter_x: float = 0.0
    decenter_y: float = 0.0
    compression_x: float = 0.0
    compression_y: float = 0.0
    angle: float = 0.0

    def on_stop(self, pupil: Tensor) -> Tensor:
        """Return the points (..., 2) of the stop that points of the unit disc go to."""
        x, y = pupil.unbind(-1)
        x = self.decenter_x + (1.0 - self.compression_x) * x
        y = self.decenter_y + (1.0 - self.compression_y) * y
        cosine, sine = math.cos(math.radians(self.angle)), math.sin(math.radians(self.angle))
        return torch.stack((cosine * x - sine * y, sine * x + cosine * y), -1)

    def margin(self, stop: Tensor) -> Tensor:
        """Return a number (...) that is positive strictly inside the ellipse, of points (..., 2) of
        the stop over its semi-diameter.
        """
        x, y = stop.unbind(-1)
        cosine, sine = math.cos(math.radians(self.angle)), math.sin(math.radians(self.angle))
        x, y = cosine * x + sine * y, cosine * y - sine * x
        x = (x - self.decenter_x) / (1.0 - self.compression_x)
        y = (y - self.decenter_y) / (1.0 - self.compression_y)
        return 1.0 - x * x - y * y


class Fields(NamedTuple):
    """Field points of a lens.

    Attributes:
        kind: `angles`, in degrees, of an object at any distance: a ray from field (x, y) has
            direction (tan x, tan y, 1) normalised, along one axis continued by (0, sin y, cos y)
            and (sin x, 0, cos x) to 90° and beyond; or `heights`, in mm, of points of an object
            plane at a finite distance.
        points: (x, y) of each.
        weights: how much each counts, of any sum; None: all the same.
        vignetting: what part of the stop the beam of each fills; None: all of it.
    """

    kind: str
    points: tuple[tuple[float, float], ...]
    weights: tuple[float, ...] | None = None
    vignetting: tuple[Vignetting, ...] | None = None

    @property
    def from_the_side(self) -> bool:
        """Return whether light comes at 90° to the axis, or nearly, and more."""
        steep = (abs(angle) >= _STEEP for point in self.points for angle in point)
        return self.kind == "angles" and any(steep)


def require_from_the_front(angles: float | Sequence[Any] | Tensor, what: str) -> None:
    """Raise `InputError` where an angle (degrees) has no tangent, of which `what` is made."""
    if bool((torch.as_tensor(angles).detach().abs() >= 90.0).any()):
        raise InputError(f"{what} needs fields below 90 degrees to the axis")


def vignetting_margin(own: Fields | None, fields: Tensor, pupil: Tensor) -> Tensor:
    """Return a number (F, N) that is positive where points of the stop belong to a field's beam.

    A field that is one of the lens's own has the ellipse that its vignetting factors say; any other
    has all of the stop.

    Args:
        own: the fields of the lens.
        fields: (F, 2), in the same coordinates as the lens's own.
        pupil: (F, N, 2) or (N, 2), over the semi-diameter of the stop.
    """
    found = torch.ones(len(fields), pupil.shape[-2], dtype=pupil.dtype, device=pupil.device)
    if own is None or own.vignetting is None:
        return found
    for at, field in enumerate(fields.tolist()):
        for point, vignetting in zip(own.points, own.vignetting, strict=True):
            if math.dist(field, point) <= _SAME * (1.0 + math.hypot(*point)):
                found[at] = vignetting.margin(pupil[at] if pupil.ndim == 3 else pupil)
                break
    return found


def point_text(point: Sequence[float] | Tensor, digits: int = 6) -> str:
    """Return a point (x, y) as text: `-14`, or `(3, -14)` beside the y-z plane.

    Args:
        point: x and y.
        digits: significant digits.
    """
    # Adding zero leaves no negative zero.
    x, y = (f"{float(value) + 0.0:.{digits}g}" for value in point)
    return y if x == "0" else f"({x}, {y})"


def weights_text(weights: Sequence[float] | Tensor) -> str:
    """Return ` (weights 1, 2, 1)` for weights of any sum, the least positive one as unit; nothing
    where all are the same.
    """
    numbers = [float(weight) for weight in weights]
    unit = min((number for number in numbers if number > 0.0), default=1.0)
    if all(abs(number - unit) <= 1e-9 * unit for number in numbers):
        return ""
    return f" (weights {', '.join(f'{number / unit:.4g}' for number in numbers)})"


def field_label(point: Sequence[float] | Tensor, unit: str) -> str:
    """Return a field as a figure or a table shows it: `14°`, `(3, 14)°`, `−2 mm`.

    Args:
        point: x and y.
        unit: `°` or `mm`.
    """
    space = "" if unit == "°" else " "
    return f"{point_text(point)}{space}{unit}".replace("-", "−")
