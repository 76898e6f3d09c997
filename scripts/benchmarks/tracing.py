"""Forward traces and gradients, as a user calls them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.cases import Case, chunks, load, make_rays, part_of
from benchmarks.errors import gradient_error, reference_case, sensor_error
from benchmarks.golden import golden_error
from benchmarks.results import Results, Row
from benchmarks.timing import Contender, Timing, by_turns
from dolens import Lens, Rays

# The reference keeps every intermediate (0.5 to 15 kB a ray): it traces a bundle in pieces, and of
# the largest bundles only the first rays; its time a ray does not depend on their number by then.
FORWARD_CHUNK, GRADIENT_CHUNK, REFERENCE_RAYS = 1_000_000, 100_000, 1_000_000
GRADIENT, GRADIENT_OF_RAYS = "forward and gradient", "forward and gradient, rays too"
FORWARD = "forward"


@dataclass(frozen=True)
class Plan:
    """The settings of a measurement.

    Attributes:
        lenses: names of `cases`.
        dtypes: float32, float64.
        threads: torch's settings.
        rays: of a run.
        seconds: for each comparison.
        device: where.
        backends: of dolens there, the reference first.
    """

    lenses: Sequence[str]
    dtypes: Sequence[torch.dtype]
    threads: Sequence[int]
    rays: Sequence[int]
    seconds: float
    device: torch.device
    backends: Sequence[str]


def forward(case: Case, chunk: int) -> object:
    """Trace without gradients; the last chunk's rays."""
    hit = None
    with torch.no_grad():
        for rays in chunks(case.rays, chunk):
            hit = case.lens.trace(rays)
    return hit


def gradient(case: Case, chunk: int, of_rays: bool) -> None:
    """Gradients of Σ|sensor point|² in every lens parameter, and in the rays where asked."""
    case.lens.zero_grad(set_to_none=True)
    for rays in chunks(case.rays, chunk):
        if of_rays:
            rays = _leaf(rays)
        case.lens.trace(rays).position.square().sum().backward()


def gradients_by_name(case: Case, rays: Rays, of_rays: bool) -> dict[str, Tensor]:
    """Name the gradients of `gradient`; rays as one, directions without their own component."""
    case.lens.zero_grad(set_to_none=True)
    if of_rays:
        rays = _leaf(rays)
    case.lens.trace(rays).position.square().sum().backward()
    found = {n: p.grad for n, p in case.lens.named_parameters() if p.grad is not None}
    if of_rays:
        found["position"] = rays.position.grad
        unit, along = rays.direction.detach(), rays.direction.grad
        found["direction"] = along - (along * unit).sum(-1, keepdim=True) * unit
    case.lens.zero_grad(set_to_none=True)
    return found


def measure(results: Results, plan: Plan, parts: Sequence[str]) -> None:
    """Rows of every part, lens, precision, number of rays and of threads."""
    for part in parts:
        for name in plan.lenses:
            for dtype in plan.dtypes:
                for count in plan.rays:
                    for threads in plan.threads:
                        torch.set_num_threads(threads)
                        compare(results, plan, part, name, dtype, count, threads)


def compare(
    results: Results,
    plan: Plan,
    part: str,
    name: str,
    dtype: torch.dtype,
    count: int,
    threads: int,
    unit: str = "ns/ray/surface",
    title: str = "",
) -> None:
    """Rows of all backends on the same rays; `title` names the part in the table, if not itself."""
    rays = make_rays(name, count, dtype, plan.device)
    contenders, cases = [], {}
    for backend in plan.backends:
        lens = load(name, dtype, backend, plan.device)
        taken = rays if backend != "reference" else part_of(rays, 0, REFERENCE_RAYS)
        case = Case(name, lens, taken)
        cases[backend] = case
        contenders.append(Contender(backend, _runner(part, case, backend), case.count))
    timings = by_turns(contenders, plan.seconds, plan.device)
    reference = reference_case(Case(name, cases[plan.backends[0]].lens, rays))
    for backend, case in cases.items():
        timing = timings[backend]
        row = row_of_timing(part, case, backend, dtype, threads, count, timing, unit)
        if not timing.failure:
            row |= _errors(part, case, reference, plan.device)
            row |= ratio_to(timing, timings["reference"])
            row["note"] = "; ".join(
                filter(None, (_pieces(part, case, backend, count), row["note"]))
            )
        results.add(Row(**row | {"part": title or part}))


def measure_light(results: Results, plan: Plan) -> None:
    """Rows of a trace that finds the share of light that bare glass passes, beside a plain one."""
    for name in plan.lenses:
        for dtype in plan.dtypes:
            lens = load(name, dtype, "cpu", plan.device)
            bare = lens.coated("none")
            exact = load(name, torch.float64, "reference", plan.device).coated("none")
            for count in plan.rays:
                rays = make_rays(name, count, dtype, plan.device)
                case, few = Case(name, lens, rays), part_of(rays, 0, 10**4)
                with torch.no_grad():
                    known = exact.trace(few, transmission=True)
                    found = bare.trace(few, transmission=True).transmission
                error = float((found - known.transmission)[known.valid].abs().max())
                for threads in plan.threads:
                    torch.set_num_threads(threads)
                    for part in (FORWARD, GRADIENT):
                        runs = {"cpu": (lens, False), "cpu, light": (bare, True)}
                        timings = by_turns(
                            [
                                Contender(backend, _light_runner(part, *run, rays), count)
                                for backend, run in runs.items()
                            ],
                            plan.seconds,
                            plan.device,
                        )
                        timing = timings["cpu, light"]
                        row = row_of_timing(
                            f"light, {part}", case, "cpu, light", dtype, threads, count, timing,
                            "ns/ray/surface",
                        )  # fmt: skip
                        row |= {"error": error, "error_unit": "share of light"}
                        row |= {"error_against": "float64 reference, same rays"}
                        results.add(Row(**row | beside(timing, timings["cpu"])))


def _light_runner(part: str, lens: Lens, light: bool, rays: Rays) -> Callable[[], None]:
    def run() -> None:
        with torch.set_grad_enabled(part == GRADIENT):
            hit = lens.trace(rays, transmission=light)
        if part == GRADIENT:
            lens.zero_grad(set_to_none=True)
            total = hit.position.square().sum()
            (total + hit.transmission.sum() if light else total).backward()

    return run


def row_of_timing(
    part: str,
    case: Case,
    backend: str,
    dtype: torch.dtype,
    threads: int,
    count: int,
    timing: Timing,
    unit: str,
) -> dict:
    """A row's columns of time, ns per ray, or per ray and surface as the unit says."""
    scale = 1e9 / (case.surfaces if unit.endswith("surface") else 1)
    return {
        "part": part,
        "lens": case.name,
        "backend": backend,
        "device": case.rays.position.device.type,
        "dtype": str(dtype)[6:],
        "threads": threads,
        "rays": count,
        **timing.columns(scale, unit),
    }


def ratio_to(timing: Timing, reference: Timing) -> dict:
    """A row's columns of the ratio; none where the reference failed."""
    if reference.failure:
        return {}
    low, middle, high = timing.ratio(reference)
    return {"ratio": middle, "ratio_low": low, "ratio_high": high}


def beside(timing: Timing, ours: Timing) -> dict[str, float]:
    """A row's columns of how many times longer than ours it took, round by round."""
    if ours.failure:
        return {}
    low, middle, high = ours.ratio(timing)
    return {"times_ours": middle, "times_ours_low": low, "times_ours_high": high}


def _runner(part: str, case: Case, backend: str):  # noqa: ANN202 - a function of nothing
    whole = max(case.count, 1)
    pieces = backend == "reference"
    if part == FORWARD:
        return lambda: forward(case, FORWARD_CHUNK if pieces else whole)
    of_rays = part == GRADIENT_OF_RAYS
    return lambda: gradient(case, GRADIENT_CHUNK if pieces else whole, of_rays)


def _pieces(part: str, case: Case, backend: str, count: int) -> str:
    """Return how the reference was run, where not all at once."""
    chunk = FORWARD_CHUNK if part == FORWARD else GRADIENT_CHUNK
    if backend != "reference" or case.count <= chunk:
        first = f"its first {case.count:.0e} rays: all need too much memory"
        return first if case.count < count else ""
    first = f"of its first {case.count:.0e} rays " if case.count < count else ""
    return f"{first}in pieces of {chunk:.0e} for its memory"


def _errors(part: str, case: Case, reference: Case, device: torch.device) -> dict:
    """A row's columns of error."""
    point, valid, differ = sensor_error(case, reference)
    dtype, backend = case.lens.dtype, case.lens.backend
    golden, golden_differ = golden_error(case.name, dtype, backend, device)
    columns = {
        "error": point,
        "error_unit": "mm",
        "valid": valid,
        "golden_mm": golden,
        "error_against": "float64 reference, same rays",
        "note": "; ".join(
            f"{count} {what}"
            for count, what in ((differ, "valid in one only"), (golden_differ, "golden statuses"))
            if count
        ),
    }
    if part != FORWARD:
        of_rays = part == GRADIENT_OF_RAYS
        worst, where = gradient_error(
            case, reference, lambda case, rays: gradients_by_name(case, rays, of_rays)
        )
        columns |= {"error": worst, "error_unit": "relative"}
        columns["note"] = "; ".join(
            filter(None, (columns["note"], f"worst: {where}" * (worst > 0)))
        )
    return columns


def _leaf(rays: Rays) -> Rays:
    return Rays(
        rays.position.detach().requires_grad_(),
        rays.direction.detach().requires_grad_(),
        rays.wavelength,
    )
