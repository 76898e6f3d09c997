"""Measure each kind of surface beside the even asphere: time a ray and surface, by turns.

python scripts/surface_kinds.py                1e5 rays, one thread, both precisions
python scripts/surface_kinds.py --rays 1e6 --seconds 10

A singlet has two surfaces of a kind (20 mm of focal length, f/4).  Writes
outputs/surface_kinds/<date_time>.csv.
"""

import argparse
import csv
import math
from datetime import datetime

import torch
from benchmarks.cases import ROOT
from benchmarks.timing import Contender, by_turns

from dolens import Lens, Rays
from dolens.prescriptions import lens_from_prescription

_U = [[1e-4 * math.cos(0.7 * i) * math.sin(0.5 * j) for i in range(33)] for j in range(33)]
_DISC = {"normalization_radius": 5.0}
# Shape of surface 1; surface 2 has radii of opposite sign.
KINDS: dict[str, dict] = {
    "even_asphere": {"radius": 20.0, "conic": -0.5, "a4": 1e-6, "a6": 1e-9, "a8": 1e-11},
    "sphere": {"radius": 20.0},
    "odd_asphere": {"radius": 20.0, "conic": -0.5, "a3": 1e-5, "a4": 1e-6, "a5": 1e-8},
    "biconic": {"radius_x": 20.0, "radius_y": 22.0, "conic_x": -0.5, "conic_y": 0.1},
    "toroid": {"radius_x": 20.0, "radius_y": 22.0, "conic_y": 0.1, "a4": 1e-6},
    "zernike_fringe": {"radius": 20.0, "z4": 1e-3, "z9": 1e-4, "z5": 2e-4, "z8": 1e-4, **_DISC},
    "zernike_standard": {"radius": 20.0, **{f"z{j}": 1e-4 / j for j in range(4, 38)}, **_DISC},
    "q_con": {"radius": 20.0, **{f"q{m}": 1e-3 / (m + 1) for m in range(6)}, **_DISC},
    "q_bfs": {"radius": 20.0, **{f"q{m}": 1e-3 / (m + 1) for m in range(6)}, **_DISC},
    "grid_sag": {"radius": 20.0, "sag": _U, "spacing_x": 0.4, "spacing_y": 0.4},
}


def singlet(kind: str, dtype: torch.dtype, backend: str) -> Lens:
    """A biconvex singlet with both surfaces of a kind."""
    front = KINDS[kind]
    back = {key: -value if key.startswith("radius") else value for key, value in front.items()}
    common = {"type": kind, "semi_diameter": 5.0}
    surfaces = {
        "1": {**common, **front, "thickness": 3.0, "material": "1.5168/64.17"},
        "2": {**common, **back, "material": "air"},
    }
    lens = lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 19.0}}, dtype)
    lens.backend = backend
    return lens


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rays", type=float, default=1e5)
    parser.add_argument("--seconds", type=float, default=2.0, help="for each kind and part")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--backend", default="cpu", help="cpu, reference or cuda")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device("cuda" if options.backend == "cuda" else "cpu")
    count = int(options.rays)
    generator = torch.Generator().manual_seed(3)
    r, azimuth, tilt = torch.rand((3, count), generator=generator, dtype=torch.float64)
    r, azimuth = 2.5 * r.sqrt(), 2.0 * math.pi * azimuth
    position = torch.stack([r * azimuth.cos(), r * azimuth.sin(), torch.full_like(r, -2.0)], -1)
    direction = torch.stack([0.0 * r, 0.1 * tilt, torch.ones_like(r)], -1)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    rows = []
    for dtype in (torch.float32, torch.float64):
        rays = Rays(position.to(device, dtype), direction.to(device, dtype), 587.5618)
        lenses = {k: singlet(k, dtype, options.backend).to(device) for k in options.kinds}
        for part in ("forward", "forward and gradient"):
            contenders = [
                Contender(kind, _runner(lens, rays, part), count) for kind, lens in lenses.items()
            ]
            timings = by_turns(contenders, options.seconds * len(contenders), device)
            for kind, timing in timings.items():
                low, middle, high = (0.5e9 * value for value in timing.quartiles())
                print(
                    f"{str(dtype)[6:]:8} {part:21} {kind:17} {middle:7.2f} ns a ray and surface "
                    f"({low:.2f} to {high:.2f})"
                )
                rows.append((str(dtype)[6:], part, kind, count, options.threads, middle, low, high))
    folder = ROOT / "outputs" / "surface_kinds"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("dtype", "part", "kind", "rays", "threads", "ns", "low", "high"))
        writer.writerows(rows)
    print(f"written to {path}")


def _runner(lens: Lens, rays: Rays, part: str):  # noqa: ANN202
    def forward() -> None:
        with torch.no_grad():
            lens.trace(rays)

    def gradient() -> None:
        lens.zero_grad(set_to_none=True)
        lens.trace(rays).position.square().sum().backward()

    return forward if part == "forward" else gradient


if __name__ == "__main__":
    main()
