"""Two ways to write a quartet as a point of the unit cube, and a scalar merit for all optimizers.

`plain` is the 17 variables between their bounds.  `scaled` leaves the focal length and the focus to
first-order optics: a lens is scaled to EFL 100 mm, and the image distance counts from the paraxial
focus.  Optimizers without derivatives then need not find the thin set of lenses that are in focus.
"""

from typing import Any

import numpy as np

from lens_search.budget import Progress
from lens_search.plain_trace import Array, first_order
from lens_search.quartet import FOCAL_LENGTH, INDICES, LOWER, UPPER, Measured, measure, split
from lens_search.stops import SEGMENTS, room, segment_of, with_stop

# So many lenses' rays stay in the processor's cache.
_BATCH = 64
# Penalties per limit of `LIMITS`, µm per mm; µm per 1 of distortion; µm per squared cosine.
_PENALTIES = np.array(
    [50.0, 1e4, 1e4, 20.0, 20.0] + [50.0] * 7 + [20.0] * 4 + [50.0] * 7 + [2e3, 20.0]
)
# Focus, mm about the paraxial one.
_DEFOCUS = 1.5
_WEAKEST = 400.0


class Plain:
    """This space is the 17 variables between their bounds."""

    name = "plain"

    def candidates(self, points: Array) -> tuple[Array, Array]:
        """Return the candidates of points of the unit cube, and what else is wrong with each."""
        return LOWER + (UPPER - LOWER) * points, np.zeros(len(points))

    def point(self, candidate: Array) -> Array:
        """Return the point of a candidate, within the cube."""
        return np.clip((candidate - LOWER) / (UPPER - LOWER), 0.0, 1.0)


class Scaled:
    """This space is of lenses scaled to the focal length, near their paraxial focus."""

    name = "scaled"

    def candidates(self, points: Array) -> tuple[Array, Array]:
        """Return the candidates of points, and how much power each lacks (times 1e5 mm)."""
        found = LOWER + (UPPER - LOWER) * points
        curvature, gap, _, pupil = split(found)
        focal, back = first_order(curvature, gap, INDICES)
        power = 1.0 / focal
        lack = np.maximum(1.0 / _WEAKEST - power, 0.0)
        scale = np.clip(FOCAL_LENGTH * np.maximum(power, 1.0 / _WEAKEST), 0.25, 4.0)
        defocus = _DEFOCUS * (2.0 * points[:, 15] - 1.0)
        image = np.clip(scale * np.clip(back, -1e3, 1e3), -50.0, 500.0) + defocus
        rows = [curvature / scale[:, None], gap * scale[:, None], image, pupil]
        return np.column_stack(rows), 1e5 * lack

    def point(self, candidate: Array) -> Array:
        """Return a point of a candidate, within the cube."""
        found = (candidate - LOWER) / (UPPER - LOWER)
        _, back = first_order(candidate[None, :8], candidate[None, 8:15], INDICES)
        found[15] = ((candidate[15] - back[0]) / _DEFOCUS + 1.0) / 2.0
        return np.clip(found, 0.0, 1.0)


SPACES = {"plain": Plain(), "scaled": Scaled()}


def point(space: Any, candidate: Array, air_stop: bool) -> Array:
    """Return the point of a candidate in a space, its stop in air if it must be."""
    found = space.point(candidate)
    if air_stop:
        segment, place = segment_of(candidate)
        part = place / room(candidate[None], np.array([segment]))[0]
        found[16] = (segment + min(max(part, 0.0), 0.999)) / SEGMENTS
    return found


class ScalarMerit:
    """The mean RMS spot and penalties of a point, µm: for one point, or for columns of many.

    Args:
        space: how points are candidates.
        progress: counts, keeps the best, and ends the search.
        part: of the budget that this merit may use.
        logarithm: whether the logarithm is returned, for optimizers that look at differences.
    """

    def __init__(
        self, space: Any, progress: Progress, part: float = 1.0, logarithm: bool = False
    ) -> None:
        self.space, self.progress, self.part, self.logarithm = space, progress, part, logarithm

    def __call__(self, points: Array) -> Array | float:
        """Return the merit of a point (17,), or of the columns of (17, points)."""
        self.progress.check(self.part)
        rows = np.atleast_2d(points.T)
        found = np.concatenate(
            [self._merit(rows[k : k + _BATCH]) for k in range(0, len(rows), _BATCH)]
        )
        return float(found[0]) if points.ndim == 1 else found

    def _merit(self, points: Array) -> Array:
        candidates, wrong = self.space.candidates(points)
        if self.progress.air_stop:
            candidates = _stopped(candidates, points[:, 16])
        measured = measure(candidates, air_stop=self.progress.air_stop)
        self.progress.see(candidates, measured)
        merit = penalised(measured) + wrong
        return np.log(merit) if self.logarithm else merit

    def candidate(self, point: Array) -> Array:
        """Return the candidate of one point, within bounds."""
        found, _ = self.space.candidates(np.clip(point, 0.0, 1.0)[None])
        if self.progress.air_stop:
            found = _stopped(found, np.clip(point[None, 16], 0.0, 1.0))
        return np.clip(found[0], LOWER, UPPER)

    def gradient(self, point: Array) -> Array:
        """Return forward differences, all 17 in one call; backward at the cube's far sides."""
        step = np.where(point > 0.5, -1e-7, 1e-7)
        found = self(np.column_stack([point[:, None], point[:, None] + np.diag(step)]))
        return (found[1:] - found[0]) / step


def _stopped(candidates: Array, part: Array) -> Array:
    """Return candidates with stops in air: a quarter of the last coordinate for each segment."""
    segment = np.minimum((part * SEGMENTS).astype(int), SEGMENTS - 1)
    found = candidates.copy()
    found[:, 16] = (part * SEGMENTS - segment) * room(candidates, segment)
    return with_stop(found, segment)


def penalised(measured: Measured) -> Array:
    """Return the mean RMS radius and the penalties of broken limits, µm."""
    return measured.mean + measured.excess @ _PENALTIES
