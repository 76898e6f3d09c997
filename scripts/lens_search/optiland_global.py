"""Optiland's global optimizers on the quartet, through its own interface.

    PYTHON_WITH_OPTILAND scripts/lens_search/optiland_global.py --method DifferentialEvolution \
        --seconds 120 --seed 1 --out FOLDER

The variables are the 17 of `quartet.py`, from the same bounds: reciprocal radii, thicknesses, the
image distance, and a stop in the entrance pupil; with --air-stop, a stop in an air space, the
middle one for seed 1.  The operands are the three RMS spots, distortion by the chief ray, the
edges, the length and the focal length; all but the last are registered here and share one call of
its tracer, with the rays of `quartet.py`.  It runs in its NumPy backend, again from the start when
it ends before its time, and gives the last part to its `LeastSquares`.  Its SHGO is left out, as
SciPy's is.  What it finds is measured by `quartet.py`, and written to
FOLDER/optiland_<method>_<seed>.json.
"""

import argparse
import json
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lens_search import quartet
from lens_search.budget import OutOfTime, Progress
from lens_search.least_squares import random_starts, to_focal_length
from lens_search.optiland_lens import NAMES, Operands, built, candidate, spheres
from lens_search.stops import FRONT, room, with_stop

# Where the stop is, by the seed: Optiland cannot move it from one space to another.
_SEGMENTS = (2, 1, 3, 0)
SEARCH = 0.9


def problem_of(optic: Any, progress: Progress) -> Any:
    """Return the optimization problem, which counts, keeps the best, and ends in time."""
    from optiland.optimization import OptimizationProblem

    Operands().register()

    class Timed(OptimizationProblem):
        part = 1.0
        best = np.inf
        best_row: quartet.Array | None = None
        air_stop = progress.air_stop

        def _seen(self, merit: float) -> None:
            progress.evaluations += 1
            if np.isfinite(merit) and merit < self.best:
                self.best = float(merit)
                self.best_row = candidate(optic)
                keep(self.best_row, progress)
            progress.check(self.part)

        def sum_squared(self) -> Any:
            found = super().sum_squared()
            self._seen(float(np.asarray(found)))
            return found

    problem = Timed()
    data = {"optic": optic}
    for name in NAMES[:3]:
        problem.add_operand(name, target=0.0, weight=1.0, input_data=data)
    for name in NAMES[3:5]:
        most = 0.99 * quartet.DISTORTION
        problem.add_operand(name, min_val=-most, max_val=most, weight=1e4, input_data=data)
    problem.add_operand(NAMES[5], target=0.0, weight=50.0, input_data=data)
    problem.add_operand(NAMES[6], max_val=quartet.LENGTH, weight=20.0, input_data=data)
    problem.add_operand("f2", target=quartet.FOCAL_LENGTH, weight=50.0, input_data=data)
    return problem


def add_variables(problem: Any, optic: Any, bounded: bool) -> None:
    """Give the problem its 17 variables, with their bounds or without."""

    def add(kind: str, number: int, low: float, high: float) -> None:
        limits = {"min_val": float(low), "max_val": float(high)} if bounded else {}
        problem.add_variable(optic, kind, surface_number=number, **limits)

    own = spheres(optic)
    stop = next(k for k in range(1, 10) if k not in own)
    for k, number in enumerate(own):
        add("reciprocal_radius", number, quartet.LOWER[k], quartet.UPPER[k])
        low, high = quartet.LOWER[8 + k], quartet.UPPER[8 + k]
        add("thickness", number, 0.05 if number == stop - 1 else low, high)
    if stop > 1:
        add("thickness", stop, 0.05, quartet.UPPER[9])
    elif problem.air_stop:
        add("thickness", stop, 0.0, FRONT)
    else:
        add("thickness", stop, -quartet.UPPER[16], -quartet.LOWER[16])


def keep(row: quartet.Array, progress: Progress) -> None:
    """Measure a lens and keep it if it is the best: not counted again."""
    for found in (row, to_focal_length(row)):
        progress.see(found[None], quartet.measure(found[None], air_stop=progress.air_stop))
        progress.evaluations -= 1


def search(method: str, progress: Progress, seed: int) -> None:
    """Search by a method of Optiland until the time is out, then by its least squares."""
    from optiland import optimization
    from optiland.optimization.optimizer.custom import CMAES, ParticleSwarm

    np.random.seed(seed)  # SciPy takes it where Optiland hands on no seed
    segment = _SEGMENTS[(seed - 1) % len(_SEGMENTS)] if progress.air_stop else None
    start = _random(np.random.default_rng(seed), segment)
    optic = built(start, segment)
    problem = problem_of(optic, progress)
    add_variables(problem, optic, bounded=method != "BasinHopping")
    problem.part = SEARCH
    run = {
        "DifferentialEvolution": lambda: optimization.DifferentialEvolution(problem).optimize(
            maxiter=10**6, disp=False, workers=1
        ),
        "DualAnnealing": lambda: optimization.DualAnnealing(problem).optimize(
            maxiter=10**6, disp=False
        ),
        "BasinHopping": lambda: optimization.BasinHopping(problem).optimize(niter=10**6),
        "CMAES": lambda: CMAES(problem).optimize(
            maxiter=10**6, disp=False, seed=seed + progress.evaluations
        ),
        "ParticleSwarm": lambda: ParticleSwarm(problem).optimize(
            maxiter=10**6, disp=False, seed=seed + progress.evaluations
        ),
        "LeastSquares": None,
    }[method]
    with suppress(OutOfTime):
        while method != "LeastSquares":
            run()
    while True:
        try:
            _polish(progress, start if problem.best_row is None else problem.best_row, segment)
            if method != "LeastSquares":
                return
            start = _random(np.random.default_rng([seed, progress.evaluations]), segment)
            problem.best_row = None
        except OutOfTime:
            return


def _random(generator: np.random.Generator, segment: int | None) -> quartet.Array:
    """Return a random lens, its stop in a segment of air."""
    row = random_starts(2000, generator)[:1]
    if segment is not None:
        where = np.array([segment])
        row[0, 16] = generator.random() * room(row, where)[0]
        row = with_stop(row, where)
    return row[0]


def _polish(progress: Progress, own: quartet.Array, segment: int | None) -> None:
    """Fit a lens by Optiland's own least squares."""
    from optiland.optimization import LeastSquares

    lens = built(np.clip(own, *_inside()), segment)
    problem = problem_of(lens, progress)
    add_variables(problem, lens, bounded=True)
    optimizer = LeastSquares(problem)
    residual = optimizer._compute_residuals_vector

    def counted(x: quartet.Array) -> quartet.Array:
        found = residual(x)
        problem._seen(float(np.sum(np.square(found))))
        return found

    optimizer._compute_residuals_vector = counted
    optimizer.optimize(maxiter=500, tol=1e-8, method_choice="trf", x_scale="jac")


def _inside() -> tuple[quartet.Array, quartet.Array]:
    margin = 1e-6 * (quartet.UPPER - quartet.LOWER)
    return quartet.LOWER + margin, quartet.UPPER - margin


def main() -> None:
    """Run one method once."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", required=True)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--air-stop", action="store_true")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    import optiland.optimization  # noqa: F401 - takes seconds, and is no part of the search

    progress = Progress(arguments.seconds, arguments.air_stop)
    search(arguments.method, progress, arguments.seed)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"optiland_{arguments.method}_{arguments.seed}.json"
    path.write_text(json.dumps(progress.as_data()))
    print(path, progress.evaluations, progress.merit, flush=True)


if __name__ == "__main__":
    main()
