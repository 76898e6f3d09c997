"""A stop in air: where it stands, and the entrance pupil that it makes.

Segments of air are numbered from the front: 0 is in front of the lens, 1 to 3 are its air spaces,
4 is behind it.  Searches use the first four.
"""

import numpy as np

from lens_search.plain_trace import Array
from lens_search.quartet import INDICES, split

SEGMENTS = 4
# How far in front of the lens a stop may stand, mm.
FRONT = 60.0


def room(candidates: Array, segment: Array) -> Array:
    """Return the length of each lens's segment of air, mm."""
    _, gap, image, _ = split(candidates)
    lengths = np.column_stack([np.full(len(candidates), FRONT), gap[:, 1::2], image])
    return lengths[np.arange(len(candidates)), segment]


def with_stop(candidates: Array, segment: Array) -> Array:
    """Return candidates whose last variable was the stop's place and now is the pupil's.

    Args:
        candidates: (lenses, 17); the last is the distance (mm) from the surface in front of the
            stop, or from the stop to the first surface where it is in front of the lens.
        segment: (lenses,) of air.
    """
    curvature, gap, _, place = split(candidates)
    # A ray from the middle of the stop towards the front, y and n·u; u as light travels.
    inside = segment > 0
    y = np.where(inside, -place, 0.0)
    u = np.ones(len(candidates))
    for k in range(7, -1, -1):
        met = inside & (k <= 2 * segment - 1)
        behind, ahead = INDICES[k], INDICES[k - 1] if k else 1.0
        bent = (behind * u + y * curvature[:, k] * (behind - ahead)) / ahead
        u = np.where(met, bent, u)
        if k:
            y = np.where(met, y - gap[:, k - 1] * u, y)
    found = candidates.copy()
    steep = np.where(np.abs(u) < 1e-6, 1e-6, u)
    found[:, 16] = np.where(inside, np.clip(-y / steep, -1e3, 1e3), -place)
    return found


def segment_of(candidate: Array) -> tuple[int, float]:
    """Return the segment and the place of a candidate's stop; the nearest where it is in glass."""
    curvature, gap, image, pupil = split(candidate[None])
    if pupil[0] <= 0.0:
        return 0, float(-pupil[0])
    y, u, before = -pupil[0], 1.0, 1.0
    best = (np.inf, 0, 0.0)
    for k, index in enumerate(INDICES):
        u = (before * u - y * curvature[0, k] * (index - before)) / index
        before = index
        length = gap[0, k] if k < 7 else image[0]
        place = -y / (u or 1e-300)
        if index == 1.0:
            near = float(np.clip(place, 0.0, length))
            best = min(best, (abs(place - near), k // 2 + 1, near))
        y = y + length * u
    return best[1], best[2]
