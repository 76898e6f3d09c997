"""Times kernels over many lenses of one structure, beside one call a lens.

    python scripts/lens_batches.py --seconds 1.0 --threads 1
    python scripts/lens_batches.py --device cuda

Lenses have four elements and a stop, 17 variables, and 3 × 32 rays each, in double precision.  Rows
are measured in turn, again and again, and the least time of each counts.  The last columns are the
difference of the sums from those of one lens at a time, and the time of one iteration of the search
(evaluation, model and bounded step) for a lens, which is always the CPU's.
"""

import argparse
import copy
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from benchmarks.timing import Contender, by_turns
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.merit import SearchMerit
from dolens.optics.jacobian import normal_equations
from dolens.optics.lens_family import FamilyRays, LensFamily
from dolens.optics.rays import Rays
from dolens.optimize.batch_least_squares import bounded_steps
from scripts.search_parts import task

START = [
    *(1.082, 0.344, -1.127, -0.978, 1.847, -0.787, -2.688, 0.312),
    *(0.0419, 0.0667, 0.6548, 0.0005, 0.0005, 0.752, 0.0381, 0.02, 0.3),
]


def problem(count: int) -> tuple[SearchMerit, Tensor]:
    """Return the merit of a quartet, and so many lenses near one that exists."""
    specification, _ = task("search_quartet")
    merit = SearchMerit.of(Arrangement(specification.groups, 2), specification)
    generator = torch.Generator().manual_seed(0)
    off = torch.randn(count, len(START), generator=generator, dtype=torch.float64)
    return merit, torch.tensor(START, dtype=torch.float64) * (1.0 + 1e-4 * off)


def measured(count: int, seconds: float, device: torch.device) -> list[str]:
    """Return a row of the table for so many lenses."""
    merit, u = problem(count)
    conditions = merit.full(count)
    values = merit.lens_values(u, merit.paraxial_of(u)[1]).to(device)
    rays, tangent = merit._launched(conditions)
    target = torch.stack([torch.zeros_like(tangent), 100.0 * tangent], -1).to(device)
    rays = FamilyRays(
        rays.position.to(device),
        rays.direction.to(device),
        None if rays.wavelength is None else rays.wavelength.to(device),
    )
    names = list(merit.family.columns)
    lens = copy.deepcopy(merit.family.lens).to(device)
    family = LensFamily(lens, names, merit.specification.wavelengths)
    # One lens as a user has it, with the numbers of the first.
    with torch.no_grad():
        for name, where in family.columns.items():
            parameter = lens.variables([name])[name]
            parameter.copy_(values[0, where].reshape(parameter.shape))
    alone = Rays(rays.position[0], rays.direction[0], merit.specification.wavelengths[0])
    leaf = values.clone().requires_grad_()

    def gradient() -> None:
        torch.autograd.grad(family.trace(leaf, rays).position.square().sum(), leaf)

    def iteration() -> None:
        model = merit.evaluate(u, conditions)
        bound = torch.full_like(u, 0.1)
        bounded_steps(model, 1e-3 * model.hessian.diagonal(dim1=1, dim2=2), -bound, bound)

    calls: dict[str, Callable[[], object]] = {
        "one": lambda: normal_equations(lens, alone, names, target[0]),
        "trace": lambda: family.trace(values, rays),
        "gradient": gradient,
        "equations": lambda: family.normal_equations(values, rays, target),
        "iteration": iteration,
    }
    contenders = [Contender(name, call) for name, call in calls.items()]
    timings = by_turns(contenders, seconds * len(calls), device, most=1_000_000)
    found = {name: float(timing.seconds.min()) for name, timing in timings.items()}
    together = family.normal_equations(
        values[:1], FamilyRays(rays.position[:1], rays.direction[:1], rays.wavelength), target[:1]
    )
    single = normal_equations(lens, alone, names, target[0])
    order = torch.cat(
        [torch.arange(p.start, p.stop) for p in (single.columns[name] for name in names)]
    )
    difference = (
        together.jtj[0] - single.jtj[order][:, order]
    ).abs().max() / single.jtj.abs().max()
    surfaces = merit.arrangement.surfaces
    per = found["equations"] / (count * tangent.shape[1] * surfaces * family.count)
    return [
        f"{count}",
        *(f"{1e6 * found[name] / count:.2f}" for name in ("trace", "gradient", "equations")),
        f"{count / found['equations']:.3g}",
        f"{1e9 * per:.2f}",
        f"{found['one'] * count / found['equations']:.1f}",
        f"{float(difference):.0e}",
        f"{1e6 * found['iteration'] / count:.1f}",
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0, help="for each figure")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--lenses", type=int, nargs="+", default=[1, 10, 100, 1000, 10_000])
    parser.add_argument(
        "--device", type=torch.device, default=torch.device("cpu"), help="cpu or cuda"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    head = (
        "lenses",
        *("trace, µs a lens", "with gradient", "normal equations"),
        "lenses a second",
        "ns a ray, surface and variable",
        "times as fast as one call a lens",
        "difference",
        "iteration of the search, µs a lens",
    )
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for count in arguments.lenses:
        print(
            "| " + " | ".join(measured(count, arguments.seconds, arguments.device)) + " |",
            flush=True,
        )


if __name__ == "__main__":
    main()
