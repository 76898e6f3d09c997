"""Time to a design: another program's least squares, then ours until it is as good.

Each problem has one lens, one set of variables and one merit.  The other program goes on until it
stops; our float64 merit judges where it ended; ours begins at the same start and goes on until its
merit is as low.  Both are timed by turns.  Where ours does not get there, the row says so.
"""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path

import numpy as np
import torch

from benchmarks.peer_problems import Problem, asphere, nikon, triplet
from benchmarks.results import Results, Row
from benchmarks.timing import quartiles
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritFunction

PART = "peers: time to a design"
_MOST = 500


def measure(
    results: Results, paths: Mapping[str, Path], lenses: Sequence[str], threads: int, quick: bool
) -> None:
    """Two rows a problem: theirs, and ours to the same merit."""
    makers = {
        "asphere": ("do", asphere),
        "nikon": ("do", nikon),
        "cooke_triplet": ("optiland", triplet),
    }
    for name, (word, make) in makers.items():
        if word not in paths or name not in lenses:
            continue
        try:
            _compare(results, make(), threads, 1 if quick else 3)
        except Exception as error:  # of another program: the table says what happened
            note = f"failed: {type(error).__name__}: {error}"
            results.add(Row(PART, name, word, note=note, failed=True))


def _compare(results: Results, problem: Problem, threads: int, rounds: int) -> None:
    import_module(problem.module)  # takes seconds, and is no part of the design
    _ours(problem, 0.0, 1)  # compiles kernels
    theirs, ours, found, reached = [], [], {}, None
    start = _judge(problem, {})
    for _ in range(rounds):
        begin = time.perf_counter()
        with redirect_stdout(StringIO()):
            found = problem.solve()
        theirs.append(time.perf_counter() - begin)
        target = _judge(problem, found)
        begin = time.perf_counter()
        reached = _ours(problem, target)
        ours.append(time.perf_counter() - begin)
    times = {problem.peer: np.array(theirs), "cpu": np.array(ours)}
    ends = {problem.peer: target, "cpu": reached.merit}
    for name, seconds in times.items():
        low, middle, high = quartiles(seconds)
        ratio = quartiles(seconds / times["cpu"])
        merit = f"root of the merit {math.sqrt(start):.4g} → {math.sqrt(ends[name]):.4g} µm"
        extra = problem.note
        if name == "cpu":
            missed = "" if reached.merit <= target else f"; not reached: {reached.stopped}"
            extra = f"{reached.iterations} iterations{missed}"
        results.add(
            Row(
                PART,
                problem.name,
                name,
                dtype="float64" if name in ("cpu", "Optiland") else "float32",
                threads=threads,
                value=middle,
                low=low,
                high=high,
                unit="s",
                runs=rounds,
                times_ours=ratio[1],
                times_ours_low=ratio[0],
                times_ours_high=ratio[2],
                note=f"{merit}; {extra}",
            )
        )


@dataclass(frozen=True)
class Reached:
    """The end of our search: merit, iterations, and why if before the target."""

    merit: float
    iterations: int
    stopped: str


def _merit(problem: Problem) -> tuple[MeritFunction, DesignVariables]:
    variables = DesignVariables(problem.lens, problem.variables)
    return problem.settings.build(problem.lens, variables), variables


def _judge(problem: Problem, parameters: Mapping[str, float]) -> float:
    """Our merit, µm², of a design."""
    merit, variables = _merit(problem)
    with torch.no_grad():
        for place, name in enumerate(variables.names):
            if name in parameters:
                variables.scaled[place] = parameters[name] / variables.scale[place]
    return merit().sum_of_squares()


def _ours(problem: Problem, target: float, most: int = _MOST) -> Reached:
    merit, variables = _merit(problem)
    optimizer = DampedLeastSquares([variables.scaled])
    reached, count = math.inf, 0
    while reached > target and not optimizer.stopped and count < most:
        reached, count = float(optimizer.step(merit)), count + 1
    return Reached(reached, count, optimizer.stopped or f"after {count} iterations")
