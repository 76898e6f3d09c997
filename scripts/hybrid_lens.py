"""A lens and pixels of heights behind it: dolens beside DeepLens's HybridLens, error and cost.

    python scripts/hybrid_lens.py
    python scripts/hybrid_lens.py --deeplens PATH

PATH is a directory from which `deeplens` (2.5.6, of the package deeplens-core) can be imported by
this Python.  A point 10 m in front of a plano-convex singlet, F/16, is imaged through a cubic
relief of 512 × 512 pixels of 4 µm; irradiances of 49 × 49 pixels of 2 µm are differentiated with
respect to all heights.  Errors are those at 50 points of a row and a diagonal, over the peak, at
the scale that suits each program best, against rays by Snell's law and Rayleigh and Sommerfeld's
integral in NumPy's double precision.  Of DeepLens the best orientation and shift are taken.
"""

import argparse
import itertools
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

COUNT, PITCH, CUBIC = 512, 0.004, 25.0  # pixels, mm, rad/mm³
RADIUS, THICK, INDEX, GAP, FAR = 15.5, 2.0, 1.5168, 1.0, 26.0
STOP, DEPTH, WAVE = 0.9, 1e4, 550e-6
SIDE, STEP, PARTS = 49, 0.002, 4  # of the window, mm; parts of a pixel that are summed
TAKEN = np.arange(0, SIDE, 2)


def phase() -> np.ndarray:
    """Return the phase of the relief, rows along +y, radians."""
    at = (np.arange(COUNT) - 0.5 * (COUNT - 1)) * PITCH
    return CUBIC * (at[None] ** 3 + at[:, None] ** 3)


def light_on_the_relief() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return height (mm), path (mm) and irradiance of rays of the axial point on the element."""
    slope = np.linspace(0.0, 1.02, 4001) * STOP / DEPTH
    dz, dx = 1.0 / np.hypot(1.0, slope), slope / np.hypot(1.0, slope)
    away = -DEPTH - RADIUS
    t = -dz * away - np.sqrt((dz * away) ** 2 - away**2 + RADIUS**2)
    height, z = t * dx, t * dz - DEPTH
    nx, nz = -height / RADIUS, (RADIUS - z) / RADIUS
    along = dx * nx + dz * nz
    more = np.sqrt(1.0 - (1.0 - along**2) / INDEX**2) - along / INDEX
    gx, gz = dx / INDEX + more * nx, dz / INDEX + more * nz
    inside = (THICK - z) / gz
    behind = GAP / np.sqrt(1.0 - (INDEX * gx) ** 2)
    end = height + inside * gx + behind * INDEX * gx
    path = t + INDEX * inside + behind
    # Of solid angle over area.
    density = np.gradient(1.0 - dz, 0.5 * end**2, edge_order=2)
    lit = height <= STOP
    return end[lit], (path - path[0])[lit], density[lit] / density[1]


def reference() -> np.ndarray:
    """Return the irradiance at the points of the row and of the diagonal."""
    height, path, density = light_on_the_relief()
    cell, k = PITCH / PARTS, 2.0 * math.pi / WAVE
    at = (np.arange(COUNT * PARTS) - 0.5 * (COUNT * PARTS - 1)) * cell
    middle = (TAKEN - SIDE // 2) * STEP
    points = [(u, 0.0) for u in middle] + [(u, u) for u in middle]
    found, relief = np.zeros(len(points), complex), phase()
    for first in range(0, len(at), 32):
        y, rows = at[first : first + 32, None], np.arange(first, first + 32) // PARTS
        square = at[None] ** 2 + y**2
        lit = square <= height[-1] ** 2
        if not lit.any():
            continue
        turned = np.repeat(relief[rows], PARTS, 1)[lit]
        across, down = (np.broadcast_to(v, lit.shape)[lit] for v in (at[None], y))
        r = np.sqrt(square[lit])
        field = np.sqrt(np.interp(r, height, density))
        field = field * np.exp(1j * (k * np.interp(r * r, height**2, path) + turned))
        for n, (u, v) in enumerate(points):
            distance = np.sqrt((across - u) ** 2 + (down - v) ** 2 + FAR**2)
            found[n] += (field * np.exp(1j * k * distance) / distance**2).sum()
    return np.abs(found) ** 2


def of_dolens() -> dict[str, Any]:
    """Return dolens's window and what it took."""
    from dolens.diffraction.element_waves import element_light
    from dolens.diffraction.entrance_beam import ObjectPoints
    from dolens.prescriptions import lens_from_prescription

    heights = (phase() / (2.0 * math.pi) * 1e6 * WAVE / 0.5).tolist()
    plane = {"type": "plane", "semi_diameter": 2.0, "material": "air"}
    rows = {
        "1": {"type": "sphere", "radius": RADIUS, "semi_diameter": STOP, "thickness": THICK,
              "material": str(INDEX)},
        "2": {**plane, "thickness": GAP},
        "3": {**plane, "diffractive": {"pixels": heights, "pitch": PITCH, "material": "1.5"}},
    }  # fmt: skip
    given = {"stop": 1, "object_distance": DEPTH, "surfaces": rows, "sensor": {"distance": FAR}}
    lens = lens_from_prescription(given)
    u = (torch.arange(SIDE, dtype=torch.float64) - SIDE // 2) * STEP

    def window() -> torch.Tensor:
        point = ObjectPoints.at([[0.0, 0.0, -DEPTH]])
        light = element_light(lens.system(), point, 1e6 * WAVE, [[0.0, 0.0]])
        found = light.field(0, light.plan(0, float(u[-1])), u, u, torch.float64)
        found.abs().square().square().sum().backward()
        return found.abs().square().detach()

    window()  # kernels are compiled
    start = time.process_time()
    return {"window": window().tolist(), "seconds": time.process_time() - start}


def of_deeplens(path: str) -> dict[str, Any]:
    """Return DeepLens's window and what it took; two samples a pixel."""
    sys.path.insert(0, path)
    from deeplens.hybridlens import HybridLens  # type: ignore[import-not-found]

    width = COUNT * PITCH
    glass = f"{INDEX}/64.17"
    surfaces = [
        {"type": "Aperture", "r": STOP, "d": 0.0, "d_next": 0.0, "mat2": "air"},
        {"type": "Spheric", "r": 1.2, "c": 1.0 / RADIUS, "roc": RADIUS, "d": 0.0,
         "d_next": THICK, "mat2": glass},
        {"type": "Plane", "r": 1.2, "c": 0.0, "d": THICK, "d_next": GAP + FAR, "mat2": "air"},
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        map_, file = Path(folder, "phase.pth"), Path(folder, "lens.json")
        torch.save(torch.tensor(phase()[::-1].copy()), map_)
        element = {"type": "pixel2d", "d_next": FAR, "res": [COUNT, COUNT], "fab_ps": PITCH,
                   "fab_step": 1 << 20, "wvln0": 1e3 * WAVE, "phase_map_path": str(map_),
                   "mat": "fused_silica"}  # fmt: skip
        given = {"info": "", "foclen": 30.0, "fnum": 16.0, "r_sensor": 0.5**0.5 * width,
                 "d_sensor": THICK + GAP + FAR, "sensor_size": [width, width],
                 "sensor_res": [2 * COUNT, 2 * COUNT], "surfaces": surfaces,
                 "DOE": element}  # fmt: skip
        file.write_text(json.dumps(given), encoding="utf-8")
        lens = HybridLens(str(file), device="cpu", dtype=torch.float64)
    lens.doe.phase_map = lens.doe.phase_map.double().requires_grad_()
    start = time.process_time()
    found = lens.psf([0.0, 0.0, -DEPTH], wvln=1e3 * WAVE, ks=SIDE, upsample_factor=2)
    found.square().sum().backward()
    return {"window": found.tolist(), "seconds": time.process_time() - start}


def error(window: np.ndarray, known: np.ndarray) -> float:
    """Return the largest error at the points over the peak, at the best scale."""
    found = np.concatenate((window[SIDE // 2], np.diag(window)))
    found = found[np.concatenate((TAKEN, SIDE + TAKEN))]
    return float(np.abs(found * (found @ known) / (found @ found) - known).max() / known.max())


def best_error(window: np.ndarray, known: np.ndarray) -> float:
    """Return the least error of all orientations and shifts up to 1.5 pixels, by Fourier series."""
    steps, frequency = np.arange(-1.5, 1.51, 0.1), np.fft.fftfreq(SIDE)
    best = math.inf
    for turned in (window, window[::-1], window[:, ::-1], window[::-1, ::-1]):
        spectrum = np.fft.fft2(turned)
        for down, across in itertools.product(steps, steps):
            shift = np.exp(-2j * math.pi * (frequency[:, None] * down + frequency * across))
            best = min(best, error(np.fft.ifft2(spectrum * shift).real, known))
    return best


def main() -> None:
    """Run each program in a process of its own, and print errors, seconds and memory."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--deeplens", help="directory that holds the package deeplens")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        torch.set_num_threads(1)
        found = of_dolens() if given.child == "dolens" else of_deeplens(given.deeplens)
        found["megabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps(found))
        return
    known = reference()
    for program in ("dolens", *(("deeplens",) if given.deeplens else ())):
        more = ["--deeplens", given.deeplens] if given.deeplens else []
        command = [sys.executable, "-P", __file__, "--child", program, *more]
        out = subprocess.run(command, capture_output=True, text=True, check=False)
        if out.returncode:
            sys.exit(out.stderr.strip())
        found = json.loads(out.stdout.splitlines()[-1])
        window = np.array(found["window"])
        wrong = error(window, known) if program == "dolens" else best_error(window, known)
        print(
            f"{program}: error {100.0 * wrong:.2g} % of the peak, {found['seconds']:.2g} s of the "
            f"processor, {found['megabytes']:.0f} MB"
        )


if __name__ == "__main__":
    main()
