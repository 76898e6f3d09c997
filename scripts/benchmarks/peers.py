"""Traces of other programs beside ours, by turns on the same rays.

Errors are those of rays that our float64 reference finds valid, against that reference; `golden mm`
has those of the valid d-line rays of 28 digits in tests/reference.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks import peer_designs, peer_renders
from benchmarks.cases import WAVELENGTH, Case, chunks, load, make_rays
from benchmarks.errors import compared_rays, gradient_error, reference_case, sensor_error
from benchmarks.golden import golden_point_error
from benchmarks.peer_paths import make_importable, skipped
from benchmarks.peer_programs import PEERS, Peer, default_dtype
from benchmarks.results import Results, Row
from benchmarks.timing import Contender, by_turns
from benchmarks.tracing import FORWARD, GRADIENT, Plan, beside, gradients_by_name, row_of_timing
from benchmarks.tracing import forward as forward_trace
from benchmarks.tracing import gradient as gradient_trace
from dolens import Rays

# Peers keep kilobytes a ray.
CHUNK, MOST = 100_000, 100_000
LENSES = ("cooke_triplet", "asphere", "nikon")
PARTS = ("peer_trace", "peer_render", "peer_design")
OURS = "cpu"
_CPU = torch.device("cpu")


def measure(
    results: Results, plan: Plan, paths: Mapping[str, Path], parts: tuple[str, ...], quick: bool
) -> None:
    """Rows of the peers' parts; a row that says so for every peer that was not given."""
    make_importable(paths)
    for line in skipped(paths):
        results.add(Row("peers", "", line.split()[1].strip(","), note=line, failed=True))
    if "peer_trace" in parts:
        for part in (FORWARD, GRADIENT):
            for name in plan.lenses:
                for dtype in plan.dtypes:
                    for count in plan.rays:
                        for threads in plan.threads:
                            torch.set_num_threads(threads)
                            with default_dtype(dtype):
                                _compare(results, plan, paths, part, name, dtype, count, threads)
    torch.set_num_threads(plan.threads[-1])
    if "peer_render" in parts and "do" in paths:
        peer_renders.measure(results, plan.seconds, plan.threads[-1])
    if "peer_design" in parts:
        peer_designs.measure(results, paths, plan.lenses, plan.threads[-1], quick)


def _compare(
    results: Results,
    plan: Plan,
    paths: Mapping[str, Path],
    part: str,
    name: str,
    dtype: torch.dtype,
    count: int,
    threads: int,
) -> None:
    rays = make_rays(name, count, dtype, _CPU)
    ours = Case(name, load(name, dtype, OURS, _CPU), rays)
    models: dict[str, Peer] = {}
    failures: dict[str, str] = {}
    for peer in (peer for peer in PEERS if peer.word in paths):
        try:
            models[peer.name] = peer(ours.lens)
        except Exception as error:  # of another program: the table says what happened
            failures[peer.name] = f"{type(error).__name__}: {error}"
    runs = {OURS: _ours(part, ours)}
    runs |= {key: _theirs(part, model, rays) for key, model in models.items()}
    contenders = [Contender(k, go, count) for k, go in runs.items()]
    # What else the machine does is not counted, where one thread does all the work.
    clock = time.process_time if threads == 1 else time.perf_counter
    timings = by_turns(contenders, plan.seconds, _CPU, clock=clock)
    exact = reference_case(ours)
    common = {"part": f"peers: {part}", "lens": name, "dtype": str(dtype)[6:], "rays": count}
    for key, timing in timings.items():
        row = row_of_timing(
            f"peers: {part}", ours, key, dtype, threads, count, timing, "ns/ray/surface"
        )
        if not timing.failure:
            row |= beside(timing, timings[OURS])
            try:
                error = _error(part, models[key], ours, exact) if key in models else None
            except Exception as failure:  # of another program
                error = {"note": f"no error: {type(failure).__name__}: {failure}"}
            row |= _our_error(part, ours, exact) if error is None else error
        results.add(Row(**row))
    for key, message in failures.items():
        row = common | {"backend": key, "threads": threads, "note": f"failed: {message}"}
        results.add(Row(**row, failed=True))


def _ours(part: str, case: Case) -> Callable[[], object]:
    if part == FORWARD:
        return lambda: forward_trace(case, case.count)
    return lambda: gradient_trace(case, case.count, of_rays=False)


def _theirs(part: str, model: Peer, rays: Rays) -> Callable[[], object]:
    def forward() -> None:
        with torch.no_grad():
            for piece in chunks(rays, CHUNK):
                model.sensor_points(piece, gradients=False)

    def gradient() -> None:
        for piece in chunks(rays, CHUNK):
            points, _ = model.sensor_points(piece, gradients=True)
            points.square().sum().backward()

    return forward if part == FORWARD else gradient


def _our_error(part: str, case: Case, exact: Case) -> dict[str, Any]:
    point, valid, differ = sensor_error(case, exact)
    found = {"error": point, "error_unit": "mm", "valid": valid, "error_against": "float64"}
    found["golden_mm"] = golden_point_error(
        case.name, case.lens.dtype, WAVELENGTH, lambda rays: case.lens.trace(rays).position
    )
    if differ:
        found["note"] = f"{differ} valid in one only"
    if part == GRADIENT:
        worst, _ = gradient_error(
            case, exact, lambda case, rays: gradients_by_name(case, rays, of_rays=False)
        )
        found |= {"error": worst, "error_unit": "relative", "note": "of every parameter"}
    return found


def _error(part: str, model: Peer, case: Case, exact: Case) -> dict[str, Any]:
    """Return the errors of sensor points, and of gradients where all rays of the loss are valid."""
    rays = compared_rays(case)
    with torch.no_grad():
        expected = exact.lens.trace(exact.rays)
    valid = expected.valid
    passing = Rays(rays.position[valid], rays.direction[valid], rays.wavelength)
    golden = golden_point_error(
        case.name,
        case.lens.dtype,
        WAVELENGTH,
        lambda rays: model.sensor_points(rays, gradients=False)[0],
    )
    share = float(valid.double().mean())
    found = {"error_against": "float64", "valid": share, "golden_mm": golden}
    points, leaves = model.sensor_points(passing, gradients=part == GRADIENT)
    difference = (points.detach().double() - expected.position[valid, :2]).norm(dim=-1)
    lost = int((~torch.isfinite(difference)).sum())
    note = f"{lost} of the valid rays are not finite" if lost else ""
    if part == FORWARD:
        worst = float(difference[torch.isfinite(difference)].max())
        return found | {"error": worst, "error_unit": "mm", "note": note}
    points.square().sum().backward()
    exact.lens.zero_grad(set_to_none=True)
    through = Rays(exact.rays.position[valid], exact.rays.direction[valid], exact.rays.wavelength)
    exact.lens.trace(through).position[:, :2].square().sum().backward()
    worst = 0.0
    for number, leaf in leaves.items():
        curvature = exact.lens.surfaces[number].curvature
        # A radius R = 1/c: dL/dR = -c² dL/dc.
        slope = (
            -(curvature.detach() ** 2) * curvature.grad if model.leaf_is_radius else curvature.grad
        )
        worst = max(worst, float(abs(leaf.grad.double() - slope) / abs(slope)))
    note = "; ".join(filter(None, (note, "of curvatures, all it has a gradient in")))
    return found | {"error": worst, "error_unit": "relative", "note": note}
