"""A least-squares iteration's derivatives: the Nikon lens, 22 variables, 11 532 launched rays."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.cases import Case, load
from benchmarks.results import Results, Row
from benchmarks.timing import Contender, by_turns
from benchmarks.tracing import Plan, ratio_to, row_of_timing
from dolens import Lens, Rays
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.trace import trace_surfaces, trace_to_sensor, traced_rays

Function = Callable[[Lens, Rays, list[str]], Tensor]
JACOBIAN, NORMAL_EQUATIONS = "Jacobian", "normal equations"
LENS = "nikon"
CURVED = (*range(1, 12), *range(13, 21))
VARIABLES = [
    *(f"surfaces.{number}.curvature" for number in CURVED),
    "surfaces.17.a4",
    "surfaces.18.a4",
    "sensor_distance",
]
FIELDS = (0.0, 10.0, 20.0, 32.45)  # degrees
WAVELENGTHS = (656.2725, 587.5618, 486.1327)  # nm
GRID = 31  # rays along each side of the square around the first surface's aperture


def launched_rays(lens: Lens) -> Rays:
    """(wavelengths, fields·31², 3): parallel beams aimed at the entrance pupil's square."""
    with torch.no_grad():
        pupil = lens.first_order(WAVELENGTHS[1]).entrance_pupil
    side = 0.5 * float(pupil.diameter) * torch.linspace(-1, 1, GRID, dtype=torch.float64)
    x, y = (u.reshape(-1) for u in torch.meshgrid(side, side, indexing="xy"))
    beams = []
    for field in FIELDS:
        tangent = math.tan(math.radians(field))
        direction = torch.tensor([0.0, tangent, 1.0], dtype=torch.float64)
        start = -lens.system().surfaces[0].semi_diameter
        at_pupil = torch.stack((x, y, torch.full_like(x, float(pupil.z))), -1)
        position = at_pupil + (start - float(pupil.z)) * direction
        beams.append((position, (direction / direction.norm()).expand_as(position)))
    shape = (len(WAVELENGTHS), len(FIELDS) * GRID**2, 3)
    position, direction = (
        torch.cat(part).expand(shape).to(device=lens.device, dtype=lens.dtype).contiguous()
        for part in zip(*beams, strict=True)
    )
    wavelength = torch.tensor(WAVELENGTHS, dtype=torch.float64, device=lens.device)[:, None]
    return Rays(position, direction, wavelength)


def by_two_sweeps(lens: Lens, rays: Rays, names: list[str]) -> Tensor:
    """Plain PyTorch: d(x, y)/d(variables), (2, ..., variables).

    Every ray has its own copy of each variable, so that one reverse sweep of x, and one of y,
    give every ray's row.
    """
    ray = rays.components()
    values = {
        name: value.detach().expand(ray.x.shape).clone().requires_grad_()
        for name, value in lens.variables(names).items()
    }
    system = lens.system(values)
    traced = trace_surfaces(system, ray, rays.wavelength, 1.0, path_length=True)
    traced = trace_to_sensor(system, traced, rays.wavelength)
    position = traced_rays(traced, None).position
    inputs = list(values.values())
    rows = [
        torch.stack(torch.autograd.grad(position[..., k].sum(), inputs, retain_graph=k == 0), -1)
        for k in range(2)
    ]
    return torch.stack(rows)


def by_two_sweeps_normal(lens: Lens, rays: Rays, names: list[str]) -> Tensor:
    """Plain PyTorch: JᵀJ of x and y over all rays, (variables, variables)."""
    rows = by_two_sweeps(lens, rays, names).reshape(-1, len(names))
    return rows.T @ rows


# Part → plain PyTorch's function, and the library's.
FUNCTIONS: dict[str, tuple[Function, Function]] = {
    JACOBIAN: (
        by_two_sweeps,
        lambda lens, rays, names: ray_jacobian(lens, rays, names).derivatives.movedim(-2, 0),
    ),
    NORMAL_EQUATIONS: (
        by_two_sweeps_normal,
        lambda lens, rays, names: normal_equations(lens, rays, names).jtj,
    ),
}


def measure(results: Results, plan: Plan) -> None:
    """Rows of milliseconds for the whole bundle, and relative errors by the norm."""
    for part, (plain, _) in FUNCTIONS.items():
        exact = load(LENS, torch.float64, "reference", plan.device)
        expected = plain(exact, launched_rays(exact), VARIABLES)
        for dtype in plan.dtypes:
            for threads in plan.threads:
                torch.set_num_threads(threads)
                _compare(results, plan, part, dtype, threads, expected)


def _compare(
    results: Results,
    plan: Plan,
    part: str,
    dtype: torch.dtype,
    threads: int,
    expected: Tensor,
) -> None:
    plain, ours = FUNCTIONS[part]
    runs: dict[str, Callable[[], Tensor]] = {}
    case = None
    for backend in plan.backends:
        lens = load(LENS, dtype, backend, plan.device)
        rays = launched_rays(lens)
        case = case or Case(LENS, lens, Rays(rays.position.reshape(-1, 3), rays.direction))
        run = plain if backend == "reference" else ours
        runs[backend] = lambda run=run, lens=lens, rays=rays: run(lens, rays, VARIABLES)
    timings = by_turns(
        [Contender(name, run) for name, run in runs.items()], plan.seconds, plan.device
    )
    for backend in plan.backends:
        timing = timings[backend]
        row = row_of_timing(part, case, backend, dtype, threads, case.count, timing, "")
        row |= timing.columns(1e3, "ms")
        if not timing.failure:
            error = (runs[backend]().detach().to(expected) - expected).norm() / expected.norm()
            row |= {"error": float(error), "error_unit": "relative"}
            row |= {"error_against": "float64, plain PyTorch"} | ratio_to(
                timing, timings["reference"]
            )
            row["note"] = f"{len(VARIABLES)} variables, all rays"
        results.add(Row(**row))
