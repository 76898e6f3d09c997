"""Measure the time of a fresh process to its first traced rays, kernels compiled or not."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.cases import ROOT
from benchmarks.results import Results, Row
from benchmarks.timing import quartiles
from benchmarks.tracing import Plan

CACHED, COLD = "start, kernels cached", "start, kernels compiled"
# The same without what any program that uses PyTorch waits for.
CACHED_OWN, COLD_OWN = (f"{part}, after importing torch" for part in (CACHED, COLD))
_OWN = ("dolens", "kernel_imports", "lens", "first")
_PARTS = ("python", "torch", *_OWN)


def start(name: str, dtype: str, backend: str, cache: str | None) -> dict:
    """Seconds of each part of a fresh process; raises RuntimeError where it fails."""
    environment = dict(os.environ)
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = cache
    probe = Path(__file__).with_name("start_probe.py")
    command = [sys.executable, str(probe), name, dtype, backend, repr(time.time())]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return json.loads(done.stdout)


def measure(results: Results, plan: Plan, repeats: int) -> None:
    """Rows of seconds from the process's start to its first result; backends in turn."""
    for name in plan.lenses:
        for dtype in (str(d)[6:] for d in plan.dtypes):
            runs: dict[str, list[dict]] = {backend: [] for backend in plan.backends}
            failures: dict[str, str] = {}
            for turn in range(repeats + 1):
                for backend in plan.backends:
                    if backend in failures:
                        continue
                    try:
                        found = start(name, dtype, backend, None)
                    except RuntimeError as error:
                        failures[backend] = str(error)
                        continue
                    if turn:  # the first filled the caches
                        runs[backend].append(found)
            for part, pieces in ((CACHED, _PARTS), (CACHED_OWN, _OWN)):
                for backend, found in runs.items():
                    failure = failures.get(backend, "")
                    results.add(_row(part, pieces, name, dtype, backend, found, failure))
            for backend in plan.backends:
                if backend in ("reference", *failures):
                    continue
                with tempfile.TemporaryDirectory() as empty:
                    found = [start(name, dtype, backend, empty)]
                results.add(_row(COLD, _PARTS, name, dtype, backend, found, ""))
                results.add(_row(COLD_OWN, _OWN, name, dtype, backend, found, ""))


def _row(
    part: str,
    pieces: tuple[str, ...],
    name: str,
    dtype: str,
    backend: str,
    found: list[dict],
    failure: str,
) -> Row:
    low, middle, high = quartiles([sum(run[p] for p in pieces) for run in found])
    note = f"failed: {failure}"
    if not failure:
        medians = {p: quartiles([run[p] for run in found])[1] for p in (*_PARTS, "second")}
        note = (
            f"python {medians['python']:.2f}, torch {medians['torch']:.2f}, "
            f"dolens {medians['dolens']:.2f}, numba {medians['kernel_imports']:.2f}, "
            f"lens {medians['lens']:.2f}, first trace {medians['first']:.3f}, "
            f"second {medians['second']:.4f} s"
        )
    return Row(
        part, name, backend, dtype=dtype, threads=1, rays=1000, value=middle, low=low, high=high,
        unit="s", runs=len(found), note=note, failed=bool(failure),
    )  # fmt: skip
