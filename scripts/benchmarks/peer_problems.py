"""Design problems that another program and ours solve: lens, variables, merit, and its solver."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

import dolens
from benchmarks.cases import ROOT, WAVELENGTH
from benchmarks.peer_programs import optiland_optic, source_lens
from dolens import Lens
from dolens.optimize import MeritSettings

# dO takes many seconds an iteration of the Nikon lens: one line, and so many iterations, and rays
# along a spot's side.
NIKON_LINES, NIKON_ITERATIONS, NIKON_GRID = (587.5618,), 4, 11
# Optiland's least squares of the triplet creeps from here on.
TRIPLET_EVALUATIONS = 30


@dataclass(frozen=True)
class Problem:
    """A design problem as ours and as theirs.

    Attributes:
        name: of the lens.
        peer: the other program's name.
        module: of the other program, that solves.
        lens: at the start, float64.
        variables: of ours.
        settings: of the merit.
        solve: runs the other program from the same start; the design's parameters by our names.
        note: which solver, and what limits it.
    """

    name: str
    peer: str
    module: str
    lens: Lens
    variables: Mapping[str, Mapping[str, float] | None]
    settings: MeritSettings
    solve: Callable[[], dict[str, float]]
    note: str


def _load(name: str, index_model: str) -> Lens:
    path = ROOT / "conf" / "lens" / f"{name}.yaml"
    return dolens.load_lens(path, torch.float64, index_model, "cpu").requires_grad_(False)


def asphere() -> Problem:
    """dO's example `spherical_aberration`: Table I."""
    lens = _load("asphere", "do")

    def solve() -> dict[str, float]:
        import diffoptics

        model = source_lens(lens)
        wavelength = torch.tensor([532.8])

        def points() -> torch.Tensor:
            ray = model.sample_ray(wavelength, M=31, R=15.0)
            return model.trace_to_sensor(ray)[..., :2]

        names = ["surfaces[0].c", "surfaces[0].k", "surfaces[0].ai"]
        solver = diffoptics.LM(model, names, 1e-4, option="diag")
        solver.optimize(points, lambda y: 0.0 - y, maxit=300)
        first = model.surfaces[0]
        values = (first.c, first.k, first.ai[0])
        keys = ("surfaces.1.curvature", "surfaces.1.conic", "surfaces.1.a4")
        return {key: float(value) for key, value in zip(keys, values, strict=True)}

    variables = {
        "surfaces.1.curvature": {"scale": 0.01},
        "surfaces.1.conic": None,
        "surfaces.1.a4": {"scale": 1e-6},
    }
    settings = MeritSettings(
        [[0.0, 0.0]], [532.8], sampling="square_grid",
        sampling_options={"count": 31, "half_width": 15.0},
    )  # fmt: skip
    note = "its Levenberg-Marquardt until it stops"
    return Problem("asphere", "dO", "diffoptics", lens, variables, settings, solve, note)


def nikon() -> Problem:
    """dO's example `nikon` with fewer rays: Table II, from spheres."""
    lens = _load("nikon", "do")
    with torch.no_grad():
        for surface in (lens.surfaces["17"], lens.surfaces["18"]):
            for name, parameter in surface.named_parameters():
                if name != "curvature":
                    parameter.zero_()
    curved = [n for n in range(1, 21) if n != 12]
    settings = MeritSettings(
        [[angle, 0.0] for angle in (0.0, 10.0, 20.0, 32.45)], NIKON_LINES, sampling="square_grid",
        sampling_options={"count": NIKON_GRID}, max_vignetting=1.0,
    )  # fmt: skip
    spots = settings.rays(lens)

    def solve() -> dict[str, float]:
        import diffoptics

        model = source_lens(lens)
        for place in (16, 17):
            model.surfaces[place].ai = torch.zeros(1)
        rays = [
            diffoptics.Ray(
                spots.rays.position[spots.spot == number].float(),
                spots.rays.direction[spots.spot == number].float(),
                spots.wavelengths[number : number + 1].float(),
            )
            for number in range(spots.count)
        ]

        def points() -> torch.Tensor:
            landed = [model.trace_to_sensor(ray)[..., :2] for ray in rays]
            # Every spot counts alike, however many rays of it pass.
            mean = sum(map(len, landed)) / len(landed)
            return torch.vstack([model.rms(p)[1] * math.sqrt(mean / len(p)) for p in landed])

        names = [f"surfaces[{n - 1}].c" for n in curved]
        names += ["surfaces[16].k", "surfaces[17].k", "surfaces[16].ai", "surfaces[17].ai"]
        solver = diffoptics.LM(model, names, 1e-2, option="diag")
        solver.optimize(points, lambda y: 0.0 - y, maxit=NIKON_ITERATIONS)
        found = {f"surfaces.{n}.curvature": float(model.surfaces[n - 1].c) for n in curved}
        for n in (17, 18):
            found[f"surfaces.{n}.conic"] = float(model.surfaces[n - 1].k)
            found[f"surfaces.{n}.a4"] = float(model.surfaces[n - 1].ai[0])
        return found

    variables = {f"surfaces.{n}.curvature": None for n in curved}
    variables |= {f"surfaces.{n}.{name}": None for n in (17, 18) for name in ("conic", "a4")}
    note = f"its Levenberg-Marquardt, {NIKON_ITERATIONS} iterations, d line"
    return Problem("nikon", "dO", "diffoptics", lens, variables, settings, solve, note)


def triplet() -> Problem:
    """The Cooke triplet's six curvatures by Optiland's least squares, focal length held."""
    lens = _load("cooke_triplet", "dfc")
    fields, focal_length, weight = (0.0, 7.0, 10.0), 50.0, 1.0
    with torch.no_grad():
        for place, surface in enumerate(lens.surfaces.values()):
            surface.curvature *= 1.02 if place % 2 else 0.98
        diameter = float(lens.first_order(WAVELENGTH).entrance_pupil.diameter)

    def solve() -> dict[str, float]:
        import optiland.backend as be
        from optiland.optimization import LeastSquares, OptimizationProblem

        be.set_backend("numpy")
        optic = optiland_optic(lens)
        optic.set_aperture("EPD", diameter)
        optic.set_field_type("angle")
        for angle in fields:
            optic.add_field(y=angle)
        optic.add_wavelength(WAVELENGTH * 1e-3, is_primary=True)
        problem = OptimizationProblem()
        for angle in fields:
            data = {"optic": optic, "surface_number": -1, "Hx": 0.0, "Hy": angle / fields[-1]}
            data |= {"num_rays": 6, "wavelength": WAVELENGTH * 1e-3, "distribution": "hexapolar"}
            problem.add_operand("rms_spot_size", target=0.0, weight=1.0, input_data=data)
        problem.add_operand("f2", target=focal_length, weight=weight, input_data={"optic": optic})
        for number in range(1, 7):
            problem.add_variable(optic, "radius", surface_number=number)
        LeastSquares(problem).optimize(
            maxiter=TRIPLET_EVALUATIONS, tol=1e-9, method_choice="trf", x_scale="jac"
        )
        radii = [float(s.geometry.radius) for s in optic.surfaces.surfaces[1:-1]]
        return {f"surfaces.{n}.curvature": 1.0 / r for n, r in enumerate(radii, 1)}

    # Theirs is Σ RMS² in mm² and (weight·Δf)²; ours the mean of RMS² in µm².
    scaled = 1e3 * weight / math.sqrt(len(fields))
    settings = MeritSettings(
        [[0.0, angle] for angle in fields], [WAVELENGTH], max_vignetting=1.0,
        operands=[{"kind": "efl", "target": focal_length, "weight": scaled}],
    )  # fmt: skip
    variables = {f"surfaces.{n}.curvature": {"scale": 0.01} for n in range(1, 7)}
    note = f"its LeastSquares (SciPy's trf, differences), {TRIPLET_EVALUATIONS} steps at most"
    return Problem(
        "cooke_triplet",
        "Optiland",
        "optiland.optimization",
        lens,
        variables,
        settings,
        solve,
        note,
    )
