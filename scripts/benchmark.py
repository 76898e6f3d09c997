"""Measure the speed of tracing beside its error: reference, kernels, and other programs.

python scripts/benchmark.py --quick        about two minutes
python scripts/benchmark.py                everything; about three quarters of an hour on two cores
python scripts/benchmark.py --peers do=PATH deeplens=PATH optiland=PATH
                                           other programs beside ours; see docs/peers.md

Writes outputs/benchmark/<date_time>/{results.csv,results.json}.  Contenders run by turns on the
same rays; numbers are medians with quartiles; ratios are of neighbouring runs.  A singlet has two
surfaces of one kind: `--parts trace --lenses singlet_q_con,singlet_toroid` compares kinds.
"""

import argparse
import os
import platform
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import torch
from benchmarks import jacobians, memory, peer_paths, peers, rendering, starting, tracing
from benchmarks.cases import LENSES, ROOT, SINGLETS
from benchmarks.results import Results
from benchmarks.tracing import FORWARD, GRADIENT, GRADIENT_OF_RAYS, Plan, compare

from dolens.errors import InputError

PARTS = ("trace", "light", "rays", "memory", "peak", "jacobian", "b_spline", "render", "start")
BUSY = 0.7  # processes of the last minute
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    many = _list_of(str)
    parser.add_argument("--quick", action="store_true", help="fewer rays and runs: two minutes")
    words = [f"{peer.word}=PATH" for peer in peer_paths.PEERS]
    text = f"other programs by path ({', '.join(words)}); of --parts those of peers alone"
    parser.add_argument("--peers", nargs="*", metavar="NAME=PATH", help=text)
    parser.add_argument("--rays", type=_list_of(lambda text: int(float(text))), help="1e4,1e5,...")
    parser.add_argument("--lenses", type=many, help=", ".join((*LENSES, *SINGLETS)))
    parser.add_argument("--parts", type=many, help=", ".join((*PARTS, *peers.PARTS)))
    parser.add_argument("--dtypes", type=many, default=tuple(DTYPES), help=", ".join(DTYPES))
    parser.add_argument("--threads", type=many, default=("1", "all"), help="1,all")
    parser.add_argument("--seconds", type=float, help="for each comparison")
    parser.add_argument("--pixels", type=int, help="along each side of the render")
    parser.add_argument("--output", type=Path, help="folder of this run")
    options = parser.parse_args(given)
    beside = options.peers is not None
    options.lenses = options.lenses or (peers.LENSES if beside else LENSES)
    options.parts = options.parts or (peers.PARTS if beside else PARTS)
    try:
        options.peers = peer_paths.parse(options.peers or ()) if beside else None
    except InputError as error:
        parser.error(str(error))
    for chosen, known in (
        (options.lenses, peers.LENSES if beside else (*LENSES, *SINGLETS)),
        (options.parts, (*PARTS, *peers.PARTS) if beside else PARTS),
        (options.dtypes, DTYPES),
    ):
        unknown = set(chosen) - set(known)
        if unknown:
            parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(known)}")
    quick = options.quick
    most = (10**4, 10**5) if beside else (10**4, 10**5, 10**6, 10**7)
    options.rays = options.rays or (most[:1] if beside and quick else most[:2] if quick else most)
    options.seconds = options.seconds or (0.4 if quick else 4.0)
    options.pixels = options.pixels or (64 if quick else rendering.WIDTH)
    options.output = options.output or (
        ROOT / "outputs" / "benchmark" / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    )
    return options


def main(options: argparse.Namespace) -> int:
    """Measure, print, write; the exit status is 1 where a backend of dolens failed."""
    cores = len(os.sched_getaffinity(0))
    threads = sorted({cores if text == "all" else int(text) for text in options.threads})
    if options.quick:
        threads = threads[-1:]
    results = Results(options.output, _environment(options, cores))
    print("\n".join(f"{key}: {value}" for key, value in results.environment.items()))
    if os.getloadavg()[0] > BUSY:
        print(
            "other programs are running: PyTorch's threads wait for each other after every "
            "operation, so with all threads the ratios flatter the kernels; one thread is fairer"
        )
    devices = [(torch.device("cpu"), ("reference", "cpu"))]
    if torch.cuda.is_available():
        devices.append((torch.device("cuda"), ("reference", "cuda")))
    for device, backends in devices:
        plan = Plan(
            options.lenses,
            [DTYPES[name] for name in options.dtypes],
            threads if device.type == "cpu" else threads[-1:],
            options.rays,
            options.seconds,
            device,
            backends,
        )
        _measure(results, plan, options)
    if options.peers is not None:
        on_cpu = Plan(**vars(plan) | _on_cpu(threads))
        peers.measure(results, on_cpu, options.peers, options.parts, options.quick)
    results.write()
    failed = [row for row in results.rows if row.failed]
    for row in failed:
        print(f"without a result: {row.part}, {row.lens}, {row.backend} {row.dtype}: {row.note}")
    print(f"\nwritten to {options.output}")
    return int(any(row.backend in ("reference", "cpu", "cuda") for row in failed))


def _measure(results: Results, plan: Plan, options: argparse.Namespace) -> None:
    """The parts asked for, on one device."""
    parts = options.parts
    one_or_all = plan.lenses[:1] if options.quick else plan.lenses
    if "trace" in parts:
        tracing.measure(results, plan, (FORWARD, GRADIENT))
    if "light" in parts and plan.device.type == "cpu":
        tracing.measure_light(results, plan)
    if "rays" in parts:
        fewer = plan.rays[-1:] if options.quick else [n for n in plan.rays if n <= 10**6]
        chosen = {"rays": fewer, "lenses": one_or_all}
        tracing.measure(results, Plan(**vars(plan) | chosen), (GRADIENT_OF_RAYS,))
    if "b_spline" in parts:
        count = max(n for n in plan.rays if n <= 10**6 or n == min(plan.rays))
        for part, title in (
            (FORWARD, "B-spline forward"),
            (GRADIENT, "B-spline forward and gradient"),
        ):
            for dtype in plan.dtypes:
                for threads in plan.threads:
                    torch.set_num_threads(threads)
                    compare(results, plan, part, "b_spline", dtype, count, threads, "ns/ray", title)
    if "memory" in parts:
        memory.measure_saved(results, plan)
    if "peak" in parts and plan.device.type == "cpu":
        memory.measure_peak(results, Plan(**vars(plan) | {"lenses": one_or_all}))
    if "jacobian" in parts:
        jacobians.measure(results, plan)
    if "render" in parts:
        rendering.measure(results, plan, options.pixels)
    if "start" in parts and plan.device.type == "cpu":
        chosen = {"lenses": one_or_all, "dtypes": plan.dtypes[:1] if options.quick else plan.dtypes}
        starting.measure(results, Plan(**vars(plan) | chosen), 2 if options.quick else 5)


def _on_cpu(threads: list[int]) -> dict:
    return {"device": torch.device("cpu"), "backends": ("reference", "cpu"), "threads": threads}


def _environment(options: argparse.Namespace, cores: int) -> dict:
    """Return the programs and the machine of a measurement."""
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        processor = names[0].split(":", 1)[1].strip() if names else processor
    environment = {
        "processor": processor,
        "cores": cores,
        "load": ", ".join(f"{load:.1f}" for load in os.getloadavg()),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "options": " ".join(sys.argv[1:]) or "none",
    }
    if options.peers is not None:
        environment["peers"] = peer_paths.describe(options.peers)
    return environment


def _list_of(kind):  # noqa: ANN001, ANN202 - a parser of comma-separated values
    return lambda text: tuple(kind(item) for item in text.split(","))


if __name__ == "__main__":
    sys.exit(main(arguments()))
