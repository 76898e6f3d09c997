"""Damped least squares beside SciPy on standard problems: evaluations and final sums of squares.

python scripts/least_squares.py

Evaluations of the residuals + Jacobians of each; `!` where the end is none of the known minima.
"""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.optimize import DampedLeastSquares
from tests.optimize.standard_problems import CERTIFIED, MORE, Problem

METHODS = ("lm", "trf", "dogbox")
ITERATIONS, EVALUATIONS, TOLERANCE = 1000, 5000, 1e-12


def ours(problem: Problem, start: tuple[float, ...]) -> tuple[int, int, float]:
    """Evaluations of residuals, of Jacobians, and the sum of squares."""
    u = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    optimizer = DampedLeastSquares([u], merit_tolerance=TOLERANCE, step_tolerance=TOLERANCE)
    residuals = jacobians = 0
    for _ in range(ITERATIONS):
        optimizer.step(lambda: problem.residuals(u))
        jacobians += 1
        residuals += optimizer.last.trials
        if optimizer.stopped:
            break
    return residuals + 1, jacobians, optimizer.last.merit


def scipys(problem: Problem, start: tuple[float, ...], method: str) -> tuple[int, int, float]:
    """The same of SciPy, with variables scaled by the Jacobian's columns."""

    def residuals(u: np.ndarray) -> np.ndarray:
        return problem.residuals(torch.from_numpy(u)).numpy()

    def jacobian(u: np.ndarray) -> np.ndarray:
        return torch.autograd.functional.jacobian(problem.residuals, torch.from_numpy(u)).numpy()

    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), TOLERANCE)
    found = least_squares(
        residuals,
        np.array(start, dtype=np.float64),
        jac=jacobian,
        method=method,
        x_scale="jac",
        max_nfev=EVALUATIONS,
        **tolerances,
    )
    return found.nfev, found.njev, 2.0 * found.cost


def cell(run: Callable[[], tuple[int, int, float]], minima: tuple[float, ...]) -> str:
    """A run as text."""
    try:
        residuals, jacobians, merit = run()
    except ValueError:  # SciPy's `lm` wants as many residuals as variables
        return "refused"
    known = any(abs(merit - least) <= 1e-5 * least + 1e-14 for least in minima)
    return f"{residuals}+{jacobians} {merit:.6g}{'' if known else ' !'}"


def main() -> None:
    """Print a row for each problem and start."""
    warnings.simplefilter("ignore", RuntimeWarning)
    torch.set_num_threads(1)
    columns = ("dolens", *METHODS)
    print(f"{'':26s}" + "".join(f"{name:26s}" for name in columns))
    for name, problem in (CERTIFIED | MORE).items():
        for number, start in enumerate(problem.starts, 1):
            cells = [cell(lambda p=problem, s=start: ours(p, s), problem.minima)]
            for method in METHODS:
                cells.append(
                    cell(lambda p=problem, s=start, m=method: scipys(p, s, m), problem.minima)
                )
            print(f"{name + f', {number}':26s}" + "".join(f"{text:26s}" for text in cells))


if __name__ == "__main__":
    main()
