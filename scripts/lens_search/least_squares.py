"""SciPy's least squares on the quartet: from one start, and from many that grow."""

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from lens_search.budget import OutOfTime, Progress
from lens_search.plain_trace import Array, first_order
from lens_search.quartet import (
    BACK_FOCUS,
    FOCAL_LENGTH,
    INDICES,
    LENGTH,
    LOWER,
    UPPER,
    apart,
    measure,
    residuals,
)
from lens_search.stops import SEGMENTS, room, segment_of, with_stop

# Steps of differences, and units in which variables are alike: 1e-3/mm, and mm.
UNIT = np.array([1e-3] * 8 + [2.0] * 7 + [0.5, 5.0])
_STEP = 1e-6
# A stop in air keeps so far from the vertices beside it, mm.
_CLEAR = 0.02
# Parts of f/3's pupil and of 15° at every step: f/8 and 6° first.
GROWTH = [(3.0 / n, angle / 15.0) for n, angle in ((8, 6), (6, 8), (5, 10), (4, 12.5), (3, 15))]


def solve(
    start: Array,
    progress: Progress,
    aperture: float = 1.0,
    part: float = 1.0,
    most: int = 100,
    method: str = "trf",
    tolerance: float = 1e-5,
    stiffness: float = 1.0,
) -> OptimizeResult:
    """Fit a start by SciPy's least squares, the Jacobian by differences in one batch.

    A stop that must lie in air stays in its segment of it; its `candidate` has the 17 variables.

    Args:
        start: the 17 variables.
        progress: counts and ends the search.
        aperture: part of the pupil.
        part: of the field.
        most: residual evaluations.
        method: SciPy's word.
        tolerance: `ftol` of SciPy.
        stiffness: of the limits.
    """

    segment, place = segment_of(start) if progress.air_stop else (None, start[16])

    def rows_of(u: Array) -> Array:
        found, more = u * UNIT, np.zeros((len(u), 2))
        if segment is not None:
            where = np.full(len(u), segment)
            over = found[:, 16] - room(found, where)
            beyond = np.column_stack([-found[:, 16], over]) + _CLEAR
            more = 20.0 * stiffness * np.maximum(beyond, 0.0)
            found = with_stop(found, where)
        spots = residuals(found, part=part, aperture=aperture, stiffness=stiffness)
        return np.column_stack([spots, more])

    def function(u: Array) -> Array:
        progress.check()
        progress.evaluations += 1
        return rows_of(u[None])[0]

    def jacobian(u: Array) -> Array:
        progress.check()
        progress.evaluations += u.size
        step = np.where(u * UNIT > (LOWER + UPPER) / 2.0, -_STEP, _STEP)
        found = rows_of(np.vstack([u, u + np.diag(step)]))
        return ((found[1:] - found[0]) / step[:, None]).T

    low, high = LOWER / UNIT, UPPER / UNIT
    inside = np.clip(np.append(start[:16], place) / UNIT, low + 1e-6, high - 1e-6)
    bounds = (-np.inf, np.inf) if method == "lm" else (low, high)
    found = least_squares(
        function,
        inside,
        jacobian,
        bounds=bounds,
        method=method,
        ftol=tolerance,
        xtol=1e-8,
        x_scale="jac",
        max_nfev=most,
    )
    row = found.x[None] * UNIT
    found.candidate = row[0] if segment is None else with_stop(row, np.array([segment]))[0]
    return found


def finish(start: Array, progress: Progress, method: str, most: int = 300) -> tuple[float, Array]:
    """Fit a start at full aperture and field; return the merit (infinite where limits are broken).

    The lens is scaled to its focal length at the end, which a penalty leaves off by a little.
    """
    found = solve(start, progress, most=most, method=method).candidate
    found = np.clip(found, LOWER, UPPER)
    found = solve(found, progress, most=most, method="trf", stiffness=20.0).candidate
    found = to_focal_length(found)
    measured = measure(found[None], air_stop=progress.air_stop)
    progress.see(found[None], measured)
    merit = float(measured.mean[0]) if measured.feasible[0] else np.inf
    progress.designs.append((progress.spent, merit, found))
    return merit, found


def to_focal_length(candidate: Array) -> Array:
    """Return a candidate scaled to 100 mm, where that is a matter of a percent."""
    focal, _ = first_order(candidate[None, :8], candidate[None, 8:15], INDICES)
    scale = FOCAL_LENGTH / focal[0]
    if not 0.99 < scale < 1.01:
        return candidate
    powers = np.array([-1.0] * 8 + [1.0] * 9)
    return np.clip(candidate * scale**powers, LOWER, UPPER)


def random_starts(count: int, generator: np.random.Generator) -> Array:
    """Return random lenses of EFL 100 mm that are in paraxial focus and of a fit length.

    Curvatures are uniform, thin glass and air are likelier than thick.
    """
    curvature = generator.uniform(-0.03, 0.03, (count, 8))
    gap = np.empty((count, 7))
    gap[:, ::2] = 4.0 + generator.exponential(9.0, (count, 4))
    gap[:, 1::2] = 0.3 + generator.exponential(9.0, (count, 3))
    focal, back = first_order(curvature, gap, INDICES)
    scale = FOCAL_LENGTH / focal
    rows = np.column_stack(
        [
            curvature / scale[:, None],
            gap * scale[:, None],
            scale * back,
            generator.uniform(0.0, 1.0, count) * (gap.sum(axis=1) * scale + 20.0),
        ]
    )
    fit = (scale > 0.4) & (scale < 2.5) & (rows[:, 15] > 0.8 * BACK_FOCUS)
    fit &= rows[:, 8:16].sum(axis=1) < LENGTH
    return np.clip(rows[fit], LOWER, UPPER)


def in_air(rows: Array, generator: np.random.Generator) -> Array:
    """Return lenses with their stops anywhere in air: in front of the lens or in its spaces."""
    segment = generator.integers(0, SEGMENTS, len(rows))
    rows = rows.copy()
    rows[:, 16] = generator.random(len(rows)) * room(rows, segment)
    return with_stop(rows, segment)


def screened(
    count: int, share: float, generator: np.random.Generator, progress: Progress, grown: bool
) -> Array:
    """Return the better share of random starts by their first merit."""
    rows = random_starts(count, generator)
    if progress.air_stop:
        rows = in_air(rows, generator)
    aperture, part = GROWTH[0] if grown else (1.0, 1.0)
    merit = np.concatenate(
        [
            np.square(residuals(rows[k : k + 64], part=part, aperture=aperture)).sum(axis=1)
            for k in range(0, len(rows), 64)
        ]
    )
    progress.evaluations += len(rows)
    return rows[np.argsort(merit)[: max(1, int(share * len(rows)))]]


def multi_start(
    progress: Progress, seed: int, method: str = "trf", grown: bool = True, share: float = 0.05,
    most: int = 20, batch: int = 4000, halving: float = 0.5, stiffness: float = 1.0,
) -> None:  # fmt: skip
    """Search by random starts and least squares until the time is out.

    Args:
        progress: counts and ends the search; it keeps the designs.
        seed: of the starts.
        method: SciPy's word.
        grown: whether aperture and field grow in five steps; else each start is fitted at once.
        share: of a batch that is fitted at all.
        most: evaluations at each step.
        batch: random starts at a time.
        halving: what part of the designs goes on at each step.
        stiffness: of the limits while a design grows.
    """
    generator = np.random.default_rng(seed)
    try:
        while True:
            rows = screened(batch, share, generator, progress, grown)
            for aperture, part in GROWTH if grown else ():
                found = [
                    solve(r, progress, aperture, part, most, method, stiffness=stiffness)
                    for r in rows
                ]
                order = np.argsort([f.cost for f in found])
                rows = [found[k].candidate for k in order[: max(1, int(halving * len(order)))]]
            kept: list[Array] = []
            for row in rows:
                if all(apart(row, other) for other in kept):
                    kept.append(finish(row, progress, method)[1])
    except OutOfTime:
        pass
