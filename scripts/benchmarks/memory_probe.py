"""Run by `memory.py` in a fresh process: peak memory of one gradient, as JSON.

python memory_probe.py LENS DTYPE BACKEND RAYS
"""

import ctypes
import json
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch

from benchmarks.cases import Case, load, make_rays, part_of


def _resident(name: str) -> int:
    """Bytes, from Linux's account of this process: VmRSS now, VmHWM at its peak."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * int(re.search(rf"{name}:\s+(\d+) kB", text)[1])


def main(name: str, dtype: str, backend: str, count: int) -> None:
    """Warm up with a few rays, so that compiled kernels and pools are there, then measure."""
    torch.set_num_threads(1)
    cpu = torch.device("cpu")
    precision = getattr(torch, dtype)
    rays = make_rays(name, count, precision, cpu)
    case = Case(name, load(name, precision, backend, cpu), rays)
    case.lens.trace(part_of(rays, 0, 100)).position.sum().backward()
    # The allocator gives back what is free, so that it is not taken from there; then Linux forgets
    # the peak so far.
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = _resident("VmRSS")
    hit = case.lens.trace(rays)
    hit.position.sum().backward()
    peak = _resident("VmHWM") - before
    outputs = (hit.position, hit.direction, hit.path_length, hit.status, hit.surface, hit.valid)
    size = sum(t.numel() * t.element_size() for t in outputs)
    json.dump({"peak": peak, "outputs": size}, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:4], int(sys.argv[4]))
