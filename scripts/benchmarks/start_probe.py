"""Run by `starting.py` in a fresh process: seconds of each part of a start, as JSON.

python start_probe.py LENS DTYPE BACKEND LAUNCHED
"""

import sys
import time

seconds = {"python": time.time() - float(sys.argv[4])}
clock = time.perf_counter()


def lap(name: str) -> None:
    """Book the time since the last call."""
    global clock
    now = time.perf_counter()
    seconds[name] = now - clock
    clock = now


import torch  # noqa: E402 - imports are what is timed

lap("torch")

import dolens  # noqa: E402

lap("dolens")

if sys.argv[3] == "cpu":
    import dolens.kernels.cpu.backend
lap("kernel_imports")

import json  # noqa: E402
from pathlib import Path  # noqa: E402

root = Path(__file__).resolve().parents[2]
lens = dolens.load_lens(
    root / "conf" / "lens" / f"{sys.argv[1]}.yaml", dtype=getattr(torch, sys.argv[2])
)
lens.backend = sys.argv[3]
torch.set_num_threads(1)
lap("lens")

position = torch.zeros(1000, 3, dtype=lens.dtype)
position[:, 0] = torch.linspace(-0.1, 0.1, 1000)
position[:, 2] = -1.0
direction = torch.tensor([0.0, 0.0, 1.0], dtype=lens.dtype).expand(1000, 3)
rays = dolens.Rays(position, direction)
with torch.no_grad():
    lens.trace(rays)
    lap("first")
    lens.trace(rays)
    lap("second")
json.dump(seconds, sys.stdout)
