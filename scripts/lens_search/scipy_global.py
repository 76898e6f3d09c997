"""SciPy's global optimizers on the quartet, each with what it wants: vectors, or derivatives.

All minimise the same merit, the mean RMS spot and penalties, from the same bounds.  Each gives the
last part of its time to SciPy's least squares from the best point that it found, which none of them
comes near by itself.  `shgo` is left out: it triangulates the cube of 17 dimensions before its
first local search, and that does not end in minutes.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from scipy import optimize

from lens_search.budget import OutOfTime, Progress
from lens_search.least_squares import finish
from lens_search.plain_trace import Array
from lens_search.quartet import LOWER, UPPER, measure
from lens_search.spaces import SPACES, ScalarMerit, point

_CUBE = [(0.0, 1.0)] * LOWER.size
# The rest of a search's time is for least squares.
SEARCH = 0.9


def differential_evolution(
    merit: ScalarMerit, seed: int, population: int = 8, strategy: str = "best1bin",
    mutation: tuple[float, float] = (0.4, 0.9), crossover: float = 0.9,
) -> None:  # fmt: skip
    """Run it in generations of vectors, again from the start when its population has shrunk."""
    for run in range(1000):
        optimize.differential_evolution(
            merit, _CUBE, strategy=strategy, maxiter=10**6, popsize=population, tol=1e-4,
            mutation=mutation, recombination=crossover, rng=1000 * seed + run, polish=False,
            init="sobol", vectorized=True, updating="deferred",
        )  # fmt: skip


def dual_annealing(merit: ScalarMerit, seed: int, local: bool = True, visit: float = 2.62) -> None:
    """Run it; its local search is L-BFGS-B with all differences in one call."""
    for run in range(1000):
        optimize.dual_annealing(
            merit, _CUBE, maxiter=10**6, visit=visit, rng=1000 * seed + run,
            no_local_search=not local,
            minimizer_kwargs={
                "method": "L-BFGS-B", "jac": merit.gradient, "bounds": _CUBE,
                "options": {"maxiter": 100},
            },
        )  # fmt: skip


def basin_hopping(
    merit: ScalarMerit, seed: int, step: float = 0.05, temperature: float = 1.0, hops: int = 200
) -> None:
    """Run it from random starts; its local search is L-BFGS-B."""
    generator = np.random.default_rng(seed)
    while True:
        optimize.basinhopping(
            merit, _start(merit, generator), niter=hops, T=temperature, stepsize=step,
            rng=generator,
            minimizer_kwargs={
                "method": "L-BFGS-B", "jac": merit.gradient, "bounds": _CUBE,
                "options": {"maxiter": 200},
            },
        )  # fmt: skip


def basin_hopping_least_squares(
    merit: ScalarMerit, seed: int, step: float = 0.05, temperature: float = 1.0, hops: int = 30
) -> None:
    """Run it with SciPy's least squares as its local search."""
    generator = np.random.default_rng(seed)
    progress = merit.progress

    def local(_: Callable, x0: Array, **rest: Any) -> optimize.OptimizeResult:
        value, found = finish(merit.candidate(x0), progress, "lm", most=100)
        if not np.isfinite(value):
            value = 1e3 + float(measure(found[None]).mean[0])
        return optimize.OptimizeResult(
            x=point(merit.space, found, progress.air_stop), fun=value, success=True
        )

    while True:
        optimize.basinhopping(
            lambda x: np.inf, _start(merit, generator), niter=hops, T=temperature,
            stepsize=step, rng=generator, minimizer_kwargs={"method": local},
        )  # fmt: skip


def direct(merit: ScalarMerit, seed: int, locally_biased: bool = True) -> None:
    """Run it; it is the same for every seed, and takes one point at a time."""
    # Its C code loses the exception that says that the time is out.
    with suppress(SystemError):
        optimize.direct(
            merit, _CUBE, maxfun=10**8, maxiter=10**6, vol_tol=0.0, len_tol=0.0,
            locally_biased=locally_biased,
        )  # fmt: skip


METHODS: dict[str, Callable[..., None]] = {
    "differential_evolution": differential_evolution,
    "dual_annealing": dual_annealing,
    "basinhopping": basin_hopping,
    "basinhopping_least_squares": basin_hopping_least_squares,
    "direct": direct,
}


def search(
    name: str, progress: Progress, seed: int, space: str = "scaled", **settings: Any
) -> None:
    """Search by one of `METHODS` until the time is out, then by least squares from its best.

    Args:
        name: of the method.
        progress: counts, keeps the best and ends the search.
        seed: of random numbers.
        space: `plain` or `scaled`.
        settings: of the method; `logarithm` of the merit.
    """
    logarithm = settings.pop("logarithm", False)
    merit = ScalarMerit(SPACES[space], progress, SEARCH, logarithm)
    with suppress(OutOfTime):
        METHODS[name](merit, seed, **settings)
    with suppress(OutOfTime):
        if progress.best is not None:
            finish(np.clip(progress.best, LOWER, UPPER), progress, "lm", most=2000)


def _start(merit: ScalarMerit, generator: np.random.Generator) -> Array:
    """Return the best of some random points."""
    points = generator.random((500, LOWER.size))
    return points[int(np.argmin(merit(points.T)))]
