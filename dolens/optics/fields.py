"""Field points: where in the object the light of an analysis comes from."""

from typing import NamedTuple


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
