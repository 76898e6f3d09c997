"""Run by `calls.py` in a process of its own: µs of calls, as it is asked for them.

python call_probe.py ROOT BACKEND LENS DTYPE RAYS THREADS

ROOT is the checkout whose dolens is measured.  Every line that comes in is `CALL SECONDS CLOCK`:
the call is repeated for so long, and the mean of one is the answer, µs of `wall` or `cpu`.
"""

import sys
import time

sys.path.insert(0, sys.argv[1])

import torch

import dolens
from benchmarks.cases import load, make_rays

if not dolens.__file__.startswith(sys.argv[1]):
    sys.exit(f"dolens comes from {dolens.__file__}")
_, _, backend, name, dtype_name, rays_text, threads = sys.argv
torch.set_num_threads(int(threads))
dtype, cpu = getattr(torch, dtype_name), torch.device("cpu")
lens = load(name, dtype, backend, cpu)
rays = make_rays(name, int(rays_text), dtype, cpu)
cotangent = torch.ones_like(rays.position)


def forward() -> None:
    """Trace without a graph."""
    with torch.no_grad():
        lens.trace(rays)


def graph() -> None:
    """Trace, and keep what a gradient needs."""
    lens.trace(rays)


def gradient() -> None:
    """Trace, and sweep back to all parameters."""
    for parameter in parameters:
        parameter.grad = None
    lens.trace(rays).position.backward(cotangent)


parameters = list(lens.parameters())
calls = {"forward": forward, "graph": graph, "gradient": gradient}
for call in calls.values():
    call()
print("ready", flush=True)
for line in sys.stdin:
    name, seconds, kind = line.split()
    call, clock = calls[name], time.process_time if kind == "cpu" else time.perf_counter
    call()
    count, start = 0, clock()
    while (taken := clock() - start) < float(seconds) or count == 0:
        call()
        count += 1
    print(1e6 * taken / count, flush=True)
