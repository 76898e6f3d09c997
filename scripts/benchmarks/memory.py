"""Memory of a gradient: what is saved for the backward pass, and the peak of a fresh process."""

import json
import subprocess
import sys
from pathlib import Path

import torch

from benchmarks.cases import ROOT, Case, load, make_rays
from benchmarks.results import Results, Row
from benchmarks.tracing import Plan

SAVED, PEAK = "memory saved for backward", "peak memory beyond rays and results"
# Few enough for the reference, enough to stand out from what a process takes anyway.
PEAK_RAYS = 100_000


def saved_bytes(case: Case) -> int:
    """Bytes that autograd keeps between forward and backward, each memory counted once.

    The rays themselves count where they are kept.
    """
    storages: dict[int, int] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        hit = case.lens.trace(case.rays)
    del hit
    return sum(storages.values())


def measure_saved(results: Results, plan: Plan, count: int = 20_000) -> None:
    """Rows of bytes a ray; those of the table itself are spread over the rays too."""
    for name in plan.lenses:
        for dtype in plan.dtypes:
            rays = make_rays(name, count, dtype, plan.device)
            reference = float("nan")
            for backend in plan.backends:
                case = Case(name, load(name, dtype, backend, plan.device), rays)
                row = _row(SAVED, case, count)
                try:
                    row["value"] = saved_bytes(case) / count
                    row["note"] = "computed: every saved tensor, the rays included"
                except Exception as error:  # a backend that is missing: the table says so
                    row |= {"note": f"failed: {error}", "failed": True}
                reference = row.get("value", float("nan")) if backend == "reference" else reference
                results.add(Row(**row, ratio=reference / row.get("value", float("nan"))))


def measure_peak(results: Results, plan: Plan) -> None:
    """Rows of bytes a ray at the peak of a fresh process; on the CPU."""
    for name in plan.lenses:
        for dtype in plan.dtypes:
            rays = make_rays(name, 1, dtype, plan.device)
            reference = float("nan")
            for backend in plan.backends:
                case = Case(name, load(name, dtype, backend, plan.device), rays)
                row = _row(PEAK, case, PEAK_RAYS)
                row |= _peak(name, str(dtype)[6:], backend)
                reference = row.get("value", float("nan")) if backend == "reference" else reference
                results.add(Row(**row, ratio=reference / row.get("value", float("nan"))))


def _row(part: str, case: Case, count: int) -> dict:
    return {
        "part": part,
        "lens": case.name,
        "backend": case.lens.backend,
        "device": case.lens.device.type,
        "dtype": str(case.lens.dtype)[6:],
        "threads": 1,
        "rays": count,
        "unit": "B/ray",
    }


def _peak(name: str, dtype: str, backend: str) -> dict:
    """Columns from a fresh process."""
    probe = Path(__file__).with_name("memory_probe.py")
    command = [sys.executable, str(probe), name, dtype, backend, str(PEAK_RAYS)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    if done.returncode:
        return {"note": f"failed: {done.stderr.strip().splitlines()[-1]}", "failed": True}
    found = json.loads(done.stdout)
    return {
        "value": (found["peak"] - found["outputs"]) / PEAK_RAYS,
        "note": "fresh process: peak RSS of forward and backward of a sum, above the rays and "
        f"the results' {found['outputs'] / PEAK_RAYS:.0f} B/ray",
    }
