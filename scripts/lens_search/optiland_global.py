"""Optiland's global optimizers on the quartet, through its own interface.

    PYTHON_WITH_OPTILAND scripts/lens_search/optiland_global.py --method DifferentialEvolution \
        --seconds 120 --seed 1 --out FOLDER

The variables are the 17 of `quartet.py`, from the same bounds: reciprocal radii, thicknesses, the
image distance, and a stop in the entrance pupil in front of the lens.  The operands are the three
RMS spots, distortion by the chief ray, the edges, the length and the focal length; all but the last
are registered here and share one call of its tracer, with the rays of `quartet.py`.  It runs
in its NumPy backend.  The last part of the time is for its `LeastSquares`.  What it finds is
measured by `quartet.py` and written to FOLDER/optiland_<method>_<seed>.json.
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
from lens_search.plain_trace import Traced, pupil_rays, rms_um

WAVELENGTH = 0.5875618
RINGS, ARMS = 4, 8
NAMES = ("spot_1", "spot_2", "spot_3", "distortion_2", "distortion_3", "edges", "length", "stop")
SEARCH = 0.9


def built(start: quartet.Array) -> Any:
    """Return an Optiland lens: a stop in the entrance pupil, eight spheres, the image."""
    import optiland.backend as be
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    be.set_backend("numpy")
    optic = Optic()
    optic.add_surface(index=0, thickness=np.inf)
    optic.add_surface(index=1, thickness=-float(start[16]), is_stop=True)
    for k in range(8):
        radius = 1.0 / start[k] if start[k] else np.inf
        medium = IdealMaterial(n=quartet.INDEX) if k % 2 == 0 else "air"
        optic.add_surface(
            index=k + 2, radius=radius, thickness=float(start[8 + k]), material=medium
        )
    optic.add_surface(index=10)
    optic.set_aperture("EPD", quartet.FOCAL_LENGTH / quartet.F_NUMBER)
    optic.set_field_type("angle")
    for angle in quartet.ANGLES:
        optic.add_field(y=float(angle))
    optic.add_wavelength(WAVELENGTH, is_primary=True)
    return optic


def candidate(optic: Any) -> quartet.Array:
    """Return the 17 variables of an Optiland lens."""
    radii = np.array([float(s.geometry.radius) for s in optic.surfaces.surfaces[2:10]])
    z = np.array([float(s.geometry.cs.z) for s in optic.surfaces.surfaces[1:]])
    return np.array([*(1.0 / radii), *np.diff(z[1:]), z[0] - z[1]])


class Operands:
    """These operands share one call of Optiland's tracer for each lens: three times as fast.

    Its own `rms_spot_size` and `real_y_intercept` trace each field apart, 60 ms a lens.
    """

    def __init__(self) -> None:
        rays = pupil_rays(RINGS, ARMS)
        self.rays = rays
        self.at = b""
        self.found = np.empty(0)

    def values(self, optic: Any) -> quartet.Array:
        """Return RMS spots (µm), relative distortion, overlap of edges, length, stop's depth."""
        row = candidate(optic)
        if row.tobytes() != self.at:
            self.at, self.found = row.tobytes(), self._traced(optic, row[None])
        return self.found

    def _traced(self, optic: Any, row: quartet.Array) -> quartet.Array:
        rays, fields = self.rays, quartet.ANGLES.size
        where = np.repeat(quartet.ANGLES / quartet.ANGLES[-1], rays.x.size)
        px, py = np.tile(rays.x, fields), np.tile(rays.y, fields)
        optic.trace_generic(np.zeros(where.size), where, px, py, WAVELENGTH)
        x = np.asarray(optic.surfaces.x[-1]).reshape(1, fields, -1)
        y = np.asarray(optic.surfaces.y[-1]).reshape(1, fields, -1)
        height = np.hypot(optic.surfaces.x, optic.surfaces.y)[2:10].max(axis=1)[None]
        inner = np.minimum(height[:, :-1], height[:, 1:])
        edge = quartet.gap_at(row[:, :8], row[:, 8:15], inner)
        over = np.maximum(0.005 - edge, 0.0).sum()
        rms = rms_um(Traced(x, y, height, edge, edge), rays)[0]
        ideal = quartet.FOCAL_LENGTH * np.tan(np.radians(quartet.ANGLES[1:]))
        distortion = y[0, 1:, rays.chief] / ideal - 1.0
        depth = quartet.stop_depth(row)[0]
        return np.array([*rms, *distortion, over, row[0, 8:16].sum(), depth])

    def register(self) -> None:
        """Register an operand for each number."""
        from optiland.optimization.operand.operand import operand_registry

        for place, name in enumerate(NAMES):
            operand_registry.register(
                name, lambda optic, place=place: float(self.values(optic)[place]), overwrite=True
            )


def problem_of(optic: Any, progress: Progress) -> Any:
    """Return the optimization problem, which counts, keeps the best, and ends in time."""
    from optiland.optimization import OptimizationProblem

    Operands().register()

    class Timed(OptimizationProblem):
        part = 1.0
        best = np.inf

        def _seen(self, merit: float) -> None:
            progress.evaluations += 1
            if np.isfinite(merit) and merit < self.best:
                self.best = float(merit)
                keep(candidate(optic), progress)
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
    if progress.air_stop:
        problem.add_operand(NAMES[7], target=0.0, weight=20.0, input_data=data)
    problem.add_operand("f2", target=quartet.FOCAL_LENGTH, weight=50.0, input_data=data)
    return problem


def add_variables(problem: Any, optic: Any, bounded: bool) -> None:
    """Give the problem its 17 variables, with their bounds or without."""

    def limits(k: int) -> dict[str, float]:
        if not bounded:
            return {}
        return {"min_val": float(quartet.LOWER[k]), "max_val": float(quartet.UPPER[k])}

    for k in range(8):
        problem.add_variable(optic, "reciprocal_radius", surface_number=k + 2, **limits(k))
    for k in range(8):
        problem.add_variable(optic, "thickness", surface_number=k + 2, **limits(8 + k))
    low, high = -quartet.UPPER[16], -quartet.LOWER[16]
    more = {"min_val": float(low), "max_val": float(high)} if bounded else {}
    problem.add_variable(optic, "thickness", surface_number=1, **more)


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
    start = random_starts(2000, np.random.default_rng(seed))[0]
    optic = built(start)
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
        "SHGO": lambda: optimization.SHGO(problem).optimize(workers=1),
        "BasinHopping": lambda: optimization.BasinHopping(problem).optimize(niter=10**6),
        "CMAES": lambda: CMAES(problem).optimize(maxiter=10**6, disp=False, seed=seed),
        "ParticleSwarm": lambda: ParticleSwarm(problem).optimize(
            maxiter=10**6, disp=False, seed=seed
        ),
        "LeastSquares": lambda: None,
    }[method]
    with suppress(OutOfTime):
        run()
    while True:
        try:
            _polish(progress, start)
            if method != "LeastSquares":
                return
            start = random_starts(2000, np.random.default_rng([seed, progress.evaluations]))[0]
        except OutOfTime:
            return


def _polish(progress: Progress, start: quartet.Array) -> None:
    """Fit the best lens by Optiland's own least squares."""
    from optiland.optimization import LeastSquares

    lens = built(start if progress.best is None else np.clip(progress.best, *_inside()))
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
