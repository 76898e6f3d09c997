"""How long a fresh process takes to its first traced rays, with and without compiled kernels."""

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

CACHED, COLD = "start, kernels cached", "start, nothing cached"
_PARTS = ("python", "torch", "dolens", "kernel_imports", "lens", "first", "second")


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


def measure(results: Results, plan: Plan, repeats: int, cold: bool = True) -> None:
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
            for backend, found in runs.items():
                results.add(_row(CACHED, name, dtype, backend, found, failures.get(backend, "")))
            if not cold:
                continue
            for backend in plan.backends:
                if backend in ("reference", *failures):
                    continue
                with tempfile.TemporaryDirectory() as empty:
                    found = [start(name, dtype, backend, empty)]
                results.add(_row(COLD, name, dtype, backend, found, ""))


def _row(part: str, name: str, dtype: str, backend: str, found: list[dict], failure: str) -> Row:
    totals = [sum(run[p] for p in _PARTS if p != "second") for run in found]
    low, middle, high = quartiles(totals)
    note = f"failed: {failure}"
    if not failure:
        medians = {p: quartiles([run[p] for run in found])[1] for p in _PARTS}
        note = (
            f"python {medians['python']:.2f}, import torch {medians['torch']:.2f}, "
            f"dolens {medians['dolens']:.2f}, numba and kernels {medians['kernel_imports']:.2f}, "
            f"load lens {medians['lens']:.2f}, first trace {medians['first']:.3f}, "
            f"second {medians['second']:.4f} s"
        )
    return Row(
        part, name, backend, dtype=dtype, threads=1, rays=1000, value=middle, low=low, high=high,
        unit="s", runs=len(found), note=note, failed=bool(failure),
    )  # fmt: skip
