"""The quartet through its real stop: rays aimed at the stop's rim, in NumPy.

The stop's opening is what the real axial beam of f/3 leaves open.  Between it and the paraxial
entrance pupil of `quartet.measure` lie the aberrations of the pupil.
"""

from dataclasses import replace

import numpy as np

from lens_search.plain_trace import Array, PupilRays, Traced, trace
from lens_search.quartet import (
    ANGLES,
    DENSE,
    F_NUMBER,
    FOCAL_LENGTH,
    INDICES,
    Measured,
    distortion_of,
    judged,
    split,
)
from lens_search.stops import segment_of

_DIAMETER = FOCAL_LENGTH / F_NUMBER
_STEP = 1e-7


def measure(
    candidate: Array, rays: PupilRays = DENSE, stop: tuple[int, float] | None = None
) -> Measured | None:
    """Measure one candidate whose stop is in air; None where rays cannot be aimed at it.

    Args:
        candidate: the 17 variables.
        rays: of each beam, over the stop.
        stop: segment and place of the stop; else where its paraxial image says, in front first.
    """
    segment, place = stop or segment_of(candidate)
    curvature, gap, image, pupil = split(candidate[None])
    beams = []
    for angle in ANGLES[:, None]:
        launched = rays if segment == 0 else _aimed(candidate, segment, place, angle, rays)
        if launched is None:
            return None
        beams.append(trace(curvature, gap, INDICES, image, pupil, _DIAMETER, angle, launched))
    traced = Traced(
        np.concatenate([beam.x for beam in beams], axis=1),
        np.concatenate([beam.y for beam in beams], axis=1),
        np.max([beam.height for beam in beams], axis=0),
        np.min([beam.shortest for beam in beams], axis=0),
        np.sum([beam.lacking for beam in beams], axis=0),
    )
    return judged(candidate[None], traced, distortion_of(traced, rays), rays, air_stop=True)


def _aimed(
    candidate: Array, segment: int, place: float, angle: Array, rays: PupilRays
) -> PupilRays | None:
    """Return rays in the plane of the paraxial pupil that meet the stop where `rays` say."""
    curvature, gap, _, pupil = split(candidate[None])
    ahead = 2 * segment
    lens = curvature[:, :ahead], gap[:, : ahead - 1], INDICES[:ahead], np.array([place]), pupil

    def met(x: Array, y: Array, field: Array) -> tuple[Array, Array]:
        some = replace(rays, x=x, y=y, weight=np.zeros_like(x), rim=np.zeros(x.size, dtype=bool))
        found = trace(*lens, _DIAMETER, field, some)
        return found.x[0, 0], found.y[0, 0]

    radius = met(np.zeros(1), np.ones(1), np.zeros(1))[1][0]
    x, y = rays.x.copy(), rays.y.copy()
    for _ in range(50):
        at = met(x, y, angle)
        off = at[0] - radius * rays.x, at[1] - radius * rays.y
        if max(np.abs(off[0]).max(), np.abs(off[1]).max()) < 1e-11:
            return replace(rays, x=x, y=y)
        over, up = met(x + _STEP, y, angle), met(x, y + _STEP, angle)
        a, b = (over[0] - at[0]) / _STEP, (up[0] - at[0]) / _STEP
        c, d = (over[1] - at[1]) / _STEP, (up[1] - at[1]) / _STEP
        turn = a * d - b * c
        if not (np.abs(turn) > 1e-12).all():
            return None
        x = x - (d * off[0] - b * off[1]) / turn
        y = y - (a * off[1] - c * off[0]) / turn
    return None
