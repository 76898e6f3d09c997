"""One of Optiland's global optimizers on a plain task; `search_by_others.py` calls it.

    PYTHON_WITH_OPTILAND scripts/lens_search/optiland_search.py --task TASK.json \
        --method BasinHopping --seconds 115 --seed 0 --out FOUND.json

The merit is Σ (RMS spot/f)²/F + Σ (weight·deviation)², with the rays and limits of the search.
Variables have its own types, each scaled to its bounds; basin hopping, which takes none, pays for
leaving them.  A method that ends early begins again from another random lens; the last tenth of
the time is for `LeastSquares` from its best.
"""

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from scripts.lens_search.optiland_lens import Rays, built, deferred_places, values_of
from scripts.lens_search.plain_task import Array, PlainTask

METHODS = ("DifferentialEvolution", "DualAnnealing", "BasinHopping", "CMAES", "ParticleSwarm")
SEARCH = 0.9
# Random lenses of which the best is a start, and the step of basin hopping within the bounds.
_DRAWN, _HOP = 20, 0.1
# Of a number whose square the merit sums.
_MOST = 1e3


class OutOfTime(Exception):
    """The seconds are used up."""


class Search:
    """A search with its clock, its count and its best lens.

    Args:
        task: what to search.
        seconds: of processor time.
        seed: of random numbers.
    """

    def __init__(self, task: PlainTask, seconds: float, seed: int) -> None:
        self.task, self.rays, self.seconds = task, Rays(task), seconds
        self.random = np.random.default_rng(seed)
        self.begun, self.part, self.lenses = time.process_time(), 1.0, 0
        self.best, self.values = np.inf, None
        self.history: list[tuple[float, int, float]] = []

    @property
    def spent(self) -> float:
        """Processor seconds since the search began."""
        return time.process_time() - self.begun

    def check(self) -> None:
        """Raise `OutOfTime` when the part of the seconds is used up."""
        if self.spent > self.part * self.seconds:
            raise OutOfTime

    def rows(self, optic: Any) -> Array:
        """Return the weighted numbers of a lens, whose squares the merit sums."""
        values = values_of(self.task, optic)
        lens = self.task.lens(values)
        spots, beams = self.rays.traced(optic, lens)
        low, high = self.task.bounds
        outside = np.maximum(np.maximum(low - values, values - high), 0.0) / (high - low)
        limits = np.concatenate([self.task.deviations(lens, beams), outside])
        every = [spots / np.sqrt(spots.size), self.task.weight_of_limits * limits]
        rows = np.clip(np.nan_to_num(np.concatenate(every), nan=1.0), -_MOST, _MOST)
        self.lenses += 1
        merit = float(rows @ rows)
        if merit < self.best:
            self.best, self.values = merit, np.clip(values, low, high)
            self.history.append((self.spent, self.lenses, merit))
        return rows

    def problem(self, values: Array, bounded: bool) -> Any:
        """Return Optiland's problem for a lens of values (P,).

        Args:
            values: where it begins.
            bounded: whether variables have bounds.
        """
        from optiland.optimization import OptimizationProblem
        from optiland.optimization.operand.operand import operand_registry

        optic, search = built(self.task, values), self
        place_surfaces = deferred_places(optic)

        class Shared(OptimizationProblem):
            """In this problem all operands of a lens share one call of the tracer."""

            found: Array | None = None

            def update_optics(self) -> None:
                search.check()  # here, where least squares lets it through
                place_surfaces()
                super().update_optics()
                self.found = None

            def row(self, place: int) -> float:
                if self.found is None:
                    self.found = search.rows(optic)
                return float(self.found[place])

        problem = Shared()
        for place in range(search.rows(optic).size):
            name = f"row_{place}"
            operand_registry.register(name, lambda place: problem.row(place), overwrite=True)
            problem.add_operand(name, target=0.0, weight=1.0, input_data={"place": place})
        self._add_variables(problem, optic, bounded)
        return problem

    def _add_variables(self, problem: Any, optic: Any, bounded: bool) -> None:
        from optiland.optimization.scaling.linear import LinearScaler

        task = self.task
        column = 0

        def add(kind: str, surface: int, factor: float = 1.0, **more: int) -> None:
            nonlocal column
            low, high = factor * task.bounds[:, column]
            column += 1
            limits = {"min_val": float(low), "max_val": float(high)} if bounded else {}
            scaler = LinearScaler(1.0 / (high - low), -low / (high - low))
            problem.add_variable(
                optic, kind, surface_number=surface, scaler=scaler, **limits, **more
            )

        places = [task.sequence.index(n) + 1 for n in range(task.surfaces)]
        for surface, terms in zip(places, task.terms, strict=True):
            if terms:
                add("asphere_coeff", surface, 0.5, coeff_number=0)
            else:
                add("reciprocal_radius", surface)
        for place in range(1, len(task.sequence) + 1):
            add("thickness", place)
        for surface, terms in zip(places, task.terms, strict=True):
            for number in range(terms):
                add("asphere_coeff", surface, coeff_number=number + 1)

    def start(self) -> Array:
        """Return the best of some random lenses within the bounds; aspheres begin as paraboloids,
        since random coefficients within theirs let no ray pass.
        """
        self.check()
        low, high = self.task.bounds
        drawn = self.random.uniform(low, high, (_DRAWN, low.size))
        drawn[:, low.size - sum(self.task.terms) :] = 0.0
        rows = [self.rows(built(self.task, values)) for values in drawn]
        return drawn[int(np.argmin([row @ row for row in rows]))]


def run(search: Search, method: str) -> None:
    """Search by a method until its part of the time is out, then by least squares."""
    search.part = SEARCH
    with suppress(OutOfTime):
        while True:
            problem = search.problem(search.start(), bounded=method != "BasinHopping")
            _methods(problem, int(search.random.integers(2**31)))[method]()
    search.part = 1.0
    with suppress(OutOfTime):
        _polish(search)


def _methods(problem: Any, seed: int) -> dict[str, Callable[[], Any]]:
    from optiland import optimization
    from optiland.optimization.optimizer.custom import CMAES, ParticleSwarm

    np.random.seed(seed)  # SciPy takes it where Optiland hands on no seed
    many: dict[str, Any] = {"maxiter": 10**6, "disp": False}
    return {
        "DifferentialEvolution": lambda: optimization.DifferentialEvolution(problem).optimize(
            workers=1, **many
        ),
        "DualAnnealing": lambda: optimization.DualAnnealing(problem).optimize(**many),
        "BasinHopping": lambda: optimization.BasinHopping(problem).optimize(
            niter=30, stepsize=_HOP
        ),
        "CMAES": lambda: CMAES(problem).optimize(seed=seed, **many),
        "ParticleSwarm": lambda: ParticleSwarm(problem).optimize(seed=seed, **many),
    }


def _polish(search: Search) -> None:
    """Fit the best lens by Optiland's least squares until the time is out or it stays."""
    from optiland.optimization import LeastSquares

    before = np.inf
    while search.values is not None and search.best < (1.0 - 1e-6) * before:
        before = search.best
        problem = search.problem(search.values, bounded=True)
        LeastSquares(problem).optimize(maxiter=500, tol=1e-10, method_choice="trf", x_scale="jac")


def main() -> None:
    """Run one method once."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", type=Path, required=True)
    parser.add_argument("--method", choices=METHODS, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    import optiland.optimization  # noqa: F401 - takes seconds, and is no part of the search

    task = PlainTask(json.loads(arguments.task.read_text()))
    search = Search(task, arguments.seconds, arguments.seed)
    run(search, arguments.method)
    values = None if search.values is None else (search.values / np.array(task.scales)).tolist()
    found = {"lenses": search.lenses, "merit": search.best, "values": values}
    arguments.out.write_text(json.dumps(found | {"history": search.history}))


if __name__ == "__main__":
    main()
