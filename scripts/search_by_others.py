"""SciPy's global optimizers on the merit function of a search, with its bounds and exact gradients.

    python scripts/search_by_others.py search_triplet --stop 2 --seconds 115 --out FOLDER \
        [--methods "differential evolution,random restarts"]

The merit is that of the last stage: Σ of squared spots of all fields and squared deviations of the
specification, weighted as the search does at its end.  Differential evolution has a population of
15 lenses a variable, evaluated as one batch; basin hopping, dual annealing and random restarts
descend by L-BFGS-B with the merit's gradient, one lens at a time.  Each has so many seconds of
processor time on one core, then its best is fitted once more by the search's own finish, so that a
row says how good the basin is that was found.  A lens counts that keeps its operands to a
thousandth.  Runs that FOLDER has are not repeated.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import basinhopping, differential_evolution, dual_annealing, minimize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.growth import settled
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.search import SearchPlan
from scripts.search_parts import task

Array = NDArray[np.float64]
_TOLERANCE = 1e-3
# What a lens counts whose rays fail.
_FAILED = 1.0


@dataclass(frozen=True)
class Task:
    """The merit function of an experiment's last stage, and the plan of its finish.

    Attributes:
        merit: of the search, its stop in one place.
        plan: of the experiment.
    """

    merit: SearchMerit
    plan: SearchPlan

    @staticmethod
    def of(experiment: str, stop: int) -> "Task":
        """Return that of an experiment.

        Args:
            experiment: its name.
            stop: behind how many groups the stop stands.
        """
        specification, plan = task(experiment)
        arrangement = Arrangement.of(specification, stop)
        return Task(SearchMerit.of(arrangement, specification, plan.rings, plan.arms), plan)

    def bounds(self, curved: float) -> list[tuple[float, float]]:
        """Return the bounds of the variables u.

        Args:
            curved: greatest curvature times the focal length.
        """
        lower, upper = (end.clone() for end in self.merit.bounds())
        surfaces = self.merit.arrangement.surfaces
        lower[:surfaces], upper[:surfaces] = -curved, curved
        return list(zip(lower.tolist(), upper.tolist(), strict=True))

    def finished(self, u: Array | None) -> float | None:
        """Return the mean RMS spot, µm, of a lens after the search's own finish; None where it
        breaks its specification.
        """
        if u is None:
            return None
        lens = torch.from_numpy(np.asarray(u, dtype=np.float64))[None]
        done = settled(self.merit, lens, self.plan.finish_rounds, self.plan.finish_iterations)
        deviations = done.merit.deviations(done.values, done.conditions)
        broken = torch.where(done.merit.is_limit, deviations.clamp(min=0.0), deviations.abs())
        spot = 1e3 * float(done.merit.spots(done.values, done.conditions).mean())
        return spot if float(broken.amax()) < _TOLERANCE and np.isfinite(spot) else None


@dataclass(frozen=True)
class Run:
    """One search of one method.

    Attributes:
        experiment: the task.
        method: its name.
        seed: of its random numbers.
        seconds: of processor time that it had.
        lenses: that it traced.
        values: u of its best lens; None where rays of all lenses failed.
        spot: mean RMS spot, µm, of that lens after the search's finish; None where it breaks its
            specification.
    """

    experiment: str
    method: str
    seed: int
    seconds: float
    lenses: int
    values: list[float] | None
    spot: float | None

    def path(self, folder: Path) -> Path:
        """Return where it is kept."""
        name = f"{self.experiment}_{self.method}_{self.seed}".replace(" ", "_")
        return folder / f"{name}.json"

    def keep(self, folder: Path) -> None:
        """Write it as a file."""
        folder.mkdir(parents=True, exist_ok=True)
        self.path(folder).write_text(json.dumps(asdict(self)))


def kept(folder: Path, experiment: str) -> list[Run]:
    """Return the runs of an experiment in a folder, by method and seed."""
    found = [Run(**json.loads(path.read_text())) for path in folder.glob("*.json")]
    own = [run for run in found if run.experiment == experiment]
    return sorted(own, key=lambda run: (run.method, run.seed))


def table(runs: Iterable[Run]) -> str:
    """Return a Markdown table with a row a method, and of it the spots by seed."""
    by_method: dict[str, list[Run]] = {}
    for run in runs:
        by_method.setdefault(run.method, []).append(run)
    lines = [
        "| method | runs | seconds | lenses | mean RMS spots of those that keep the limits, µm |",
        "|---|---|---|---|---|",
    ]
    for method, own in by_method.items():
        spots = ", ".join("none" if run.spot is None else f"{run.spot:.4g}" for run in own)
        lenses = statistics.median(run.lenses for run in own)
        cells = [method, str(len(own)), f"{own[0].seconds:g}", f"{lenses:.2g}", spots]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


class OutOfTimeError(Exception):
    """The processor time is used up."""


class Objective:
    """The logarithm of the merit, with its gradient; it remembers the best lens.

    Args:
        merit: of the search.
        seconds: of processor time.
    """

    def __init__(self, merit: SearchMerit, seconds: float) -> None:
        self.merit, self.seconds = merit, seconds
        self.started, self.count = time.process_time(), 0
        self.best, self.where = np.inf, None

    def start(self, random: np.random.Generator, bounds: list[tuple[float, float]]) -> Array:
        """Return a random lens within the bounds; aspheres begin as paraboloids, since random
        coefficients within theirs let no ray pass.
        """
        found = random.uniform(*np.array(bounds).T)
        found[self.merit.arrangement.image_column + 1 :] = 0.0
        return found

    def both(self, u: Array) -> tuple[Array, Array]:
        """Return values (L,) and gradients (L, P) of lenses u (L, P)."""
        if time.process_time() - self.started > self.seconds:
            raise OutOfTimeError
        lenses = torch.from_numpy(np.ascontiguousarray(u))
        model = self.merit.evaluate(lenses, self.merit.full(len(u)))
        fine = torch.isfinite(model.merit)
        value = torch.where(fine, model.merit, _FAILED)
        slope = torch.where(fine[:, None], model.gradient / value[:, None], 0.0)
        self.count += len(u)
        found = value.log().numpy()
        if found.min() < self.best:
            self.best, self.where = float(found.min()), u[int(found.argmin())].copy()
        return found, 2.0 * slope.numpy()

    def one(self, u: Array) -> tuple[float, Array]:
        """Return the value and the gradient of one lens."""
        value, slope = self.both(u[None])
        return float(value[0]), slope[0]


Method = Callable[[Objective, list[tuple[float, float]], int], None]


def evolution(of: Objective, bounds: list[tuple[float, float]], seed: int) -> None:
    """Run SciPy's differential evolution."""
    differential_evolution(
        lambda u: of.both(u.T)[0],
        bounds,
        rng=seed,
        vectorized=True,
        updating="deferred",
        maxiter=10**9,
        tol=0.0,
        polish=False,
    )


def annealing(of: Objective, bounds: list[tuple[float, float]], seed: int) -> None:
    """Run SciPy's dual annealing."""
    local = {"method": "L-BFGS-B", "jac": lambda u: of.one(u)[1], "bounds": bounds}
    dual_annealing(lambda u: of.one(u)[0], bounds, rng=seed, maxiter=10**9, minimizer_kwargs=local)


def hopping(of: Objective, bounds: list[tuple[float, float]], seed: int) -> None:
    """Run SciPy's basin hopping from random lenses, a new one after thirty hops."""
    random = np.random.default_rng(seed)
    local = {"method": "L-BFGS-B", "jac": True, "bounds": bounds}
    while True:
        start = of.start(random, bounds)
        basinhopping(of.one, start, niter=30, stepsize=0.1, minimizer_kwargs=local, rng=random)


def restarts(of: Objective, bounds: list[tuple[float, float]], seed: int) -> None:
    """Descend from random lenses."""
    random = np.random.default_rng(seed)
    while True:
        minimize(of.one, of.start(random, bounds), jac=True, method="L-BFGS-B", bounds=bounds)


METHODS: dict[str, Method] = {
    "differential evolution": evolution,
    "dual annealing": annealing,
    "basin hopping": hopping,
    "random restarts": restarts,
}


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment")
    parser.add_argument("--stop", type=int, required=True, help="behind so many groups")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", default=",".join(METHODS), help="names with commas")
    parser.add_argument("--curved", type=float, default=5.0, help="curvatures over 1/f at most")
    parser.add_argument("--out", type=Path, required=True, help="folder of what is found")
    given = parser.parse_args()
    torch.set_num_threads(1)
    of = Task.of(given.experiment, given.stop)
    for seed, name in product(range(given.seeds), given.methods.split(",")):
        run = Run(given.experiment, name, seed, given.seconds, 0, None, None)
        if not run.path(given.out).exists():
            searched(of, of.bounds(given.curved), run).keep(given.out)
    print(table(kept(given.out, given.experiment)), flush=True)


def searched(of: Task, bounds: list[tuple[float, float]], run: Run) -> Run:
    """Return a run with what it found."""
    middle = np.mean(bounds, axis=1)[None]
    Objective(of.merit, np.inf).both(middle)  # compiles kernels: no part of the search
    objective = Objective(of.merit, run.seconds)
    with suppress(OutOfTimeError):
        METHODS[run.method](objective, bounds, run.seed)
    values = None if objective.where is None else objective.where.tolist()
    spot = of.finished(objective.where)
    return replace(run, lenses=objective.count, values=values, spot=spot)


if __name__ == "__main__":
    main()
