"""Times, memory and errors of a pixelated diffractive lens: dolens, and DeepLens beside it.

    python scripts/diffractive.py
    python scripts/diffractive.py --deeplens PATH

PATH is a directory from which `deeplens` (2.5.6, of the package deeplens-core) can be imported by
this Python.  Each run is a process of its own, one after the other in turn, so that both meet the
same machine.  Errors are those of irradiances at 36 points about the focus, as shares of their
sum, against Rayleigh and Sommerfeld's integral over parts of pixels in NumPy's double precision.
"""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np
import torch

PITCH, FOCAL, DESIGN = 0.002, 8.0, 550.0
WAVES = (450.0, 550.0, 650.0)
FIELDS = [(x, y) for x in (0.0, 1.5, 3.0) for y in (0.0, 1.5, 3.0)]
SIZE, POINTS, PARTS = 64, 6, 6
# dolens with gradients with respect to all of the lens, where time is measured.
WHOLE = "dolens_whole_lens"


class Clock:
    """Measures seconds of a block, and those of all processors together."""

    def __enter__(self) -> "Clock":
        self.start = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        now = time.perf_counter(), time.process_time()
        wall, used = (b - a for a, b in zip(self.start, now, strict=True))
        self.numbers = {"seconds": wall, "processor_seconds": used}


def phase(count: int) -> np.ndarray:
    """Return the phase of a lens and of waves on it, modulo a turn (radians)."""
    x = (np.arange(count) + 0.5 - 0.5 * count) * PITCH
    square = x[None] ** 2 + x[:, None] ** 2
    turns = -(np.sqrt(square + FOCAL**2) - FOCAL) / (1e-6 * DESIGN)
    turns += 0.3 * np.sin(2.0 * np.pi * (3.0 * x[None] + 2.0 * x[:, None]) / (count * PITCH))
    return 2.0 * np.pi * (turns % 1.0)


def places(angle: float) -> tuple[np.ndarray, float]:
    """Return the points along a side about the image, on the grid of DeepLens, and its middle."""
    middle = round(FOCAL * math.tan(math.radians(angle)) / PITCH) * PITCH
    return (np.arange(POINTS) + 0.5 - 0.5 * POINTS) * PITCH, middle


def reference(angle: float, count: int) -> np.ndarray:
    """Return the irradiance at the points, of unit sum."""
    u, middle = places(angle)
    side = count * PARTS
    x = (np.arange(side) + 0.5 - 0.5 * side) * (PITCH / PARTS)
    field = np.kron(np.exp(1j * phase(count)), np.ones((PARTS, PARTS)))
    wave = 1e-6 * DESIGN
    field = field * np.exp(2j * np.pi / wave * math.sin(math.radians(angle)) * x[:, None])
    found = np.zeros((POINTS, POINTS))
    for j, v in enumerate(u + middle):
        for i, w in enumerate(u):
            square = (w - x[None]) ** 2 + (v - x[:, None]) ** 2 + FOCAL**2
            r = np.sqrt(square)
            kernel = FOCAL / square * (1.0 / r - 2j * np.pi / wave) * np.exp(2j * np.pi / wave * r)
            found[j, i] = abs((field * kernel).sum()) ** 2
    return found / found.sum()


def dolens_lens(count: int, dtype: torch.dtype) -> Any:
    """Return a plate with the element on its back."""
    from dolens.prescriptions.build import lens_from_prescription

    half = 0.5 * count * PITCH
    plane = {"type": "plane", "semi_diameter": 2.0 * half}
    element = {"pixels": [[0.0]], "pitch": PITCH, "design_wavelength": DESIGN}
    square = {"half_width_x": half, "half_width_y": half}
    back = {"type": "plane", "aperture": square, "material": "air", "diffractive": element}
    front = {**plane, "thickness": 0.5, "material": "1.4585/67.8"}
    sensor = {"distance": FOCAL}
    rows = {"1": front, "2": back}
    lens = lens_from_prescription({"stop": 2, "surfaces": rows, "sensor": sensor}, dtype)
    step = float(lens.materials[1].index(DESIGN)) - 1.0
    heights = torch.tensor(phase(count) / (2.0 * np.pi) * DESIGN / step, dtype=dtype)
    lens.surfaces["2"].diffractive.heights = torch.nn.Parameter(heights)
    return lens


def dolens_error(angle: float, count: int, dtype: torch.dtype = torch.float32) -> np.ndarray:
    """Return the irradiance at the points, of unit sum."""
    from dolens.diffraction.element_waves import element_light
    from dolens.diffraction.entrance_beam import ObjectPoints

    u, middle = places(angle)
    points = ObjectPoints.at_infinity([[0.0, angle]])
    light = element_light(dolens_lens(count, dtype).system(), points, DESIGN, [[0.0, middle]])
    grid = torch.tensor(u)
    field = light.field(0, light.plan(0, float(u[-1])), grid, grid, dtype)
    found = field.detach().abs().double().square().numpy()
    return found / found.sum()


def dolens_seconds(count: int, all_of_it: bool) -> dict[str, float]:
    """Measure all kernels and their gradient, with respect to heights or to all of the lens."""
    from dolens.diffraction.entrance_beam import ObjectPoints
    from dolens.diffraction.pixel_psf import PixelWindow, wave_kernels

    lens = dolens_lens(count, torch.float32)
    lens.requires_grad_(all_of_it)
    lens.surfaces["2"].diffractive.requires_grad_(True)
    points = ObjectPoints.at_infinity([list(field) for field in FIELDS for _ in WAVES])
    centres = [
        [FOCAL * math.tan(math.radians(a)) for a in field] for field in FIELDS for _ in WAVES
    ]
    window = PixelWindow(PITCH, SIZE)
    with Clock() as clock:
        found = wave_kernels(lens.system(), points, list(WAVES) * len(FIELDS), centres, window)
        found.square().sum().backward()
    return clock.numbers


def deeplens_lens(count: int) -> Any:
    """Return the same element in air."""
    from deeplens.diffraclens import DiffractiveLens  # type: ignore[import-not-found]
    from deeplens.diffractive_surface import Pixel2D  # type: ignore[import-not-found]

    lens = DiffractiveLens(device="cpu")
    doe = Pixel2D(FOCAL, res=(count, count), fab_ps=PITCH, fab_step=1 << 20, wvln0=1e-3 * DESIGN)
    doe.phase_map = torch.tensor(phase(count), dtype=torch.float32, requires_grad=True)
    lens.surfaces, lens.foclen = [doe], FOCAL
    lens.sensor_size, lens.sensor_res = (count * PITCH, count * PITCH), (count, count)
    lens.pixel_size = PITCH
    return lens


def deeplens_error(angle: float, count: int) -> np.ndarray:
    """Return the irradiance at the points, of unit sum."""
    from deeplens.light import ComplexWave  # type: ignore[import-not-found]

    _, middle = places(angle)
    size = [count * PITCH, count * PITCH]
    wave = ComplexWave.plane_wave(
        wvln=1e-3 * DESIGN, z=0.0, phy_size=size, res=[count, count],
        theta_x=0.0, theta_y=math.radians(angle),
    )  # fmt: skip
    with torch.no_grad():
        out = deeplens_lens(count).forward(wave).u.abs().double().square()[0, 0].numpy()
    shift, half = round(middle / PITCH), POINTS // 2
    # Their rows run either way.
    found, columns = np.zeros((1, 1)), slice(count // 2 - half, count // 2 + half)
    for sign in (1, -1):
        row = count // 2 + sign * shift
        part = out[row - half : row + half, columns][::sign]
        found = part if part.sum() > found.sum() else found
    return found / found.sum()


def deeplens_seconds(count: int) -> dict[str, float]:
    """Measure all kernels of the lens and their gradients, one after the other."""
    lens = deeplens_lens(count)
    half = 0.5 * count * PITCH
    with Clock() as clock:
        for field in FIELDS:
            x, y = (FOCAL * math.tan(math.radians(a)) / half for a in field)
            for wave in WAVES:
                found = lens.psf([x, y, -math.inf], 1e-3 * wave, SIZE, upsample_factor=1)
                found.square().sum().backward()
    return clock.numbers


def child(program: str, what: str, count: int, threads: int) -> None:
    """Measure one thing in this process, and print it as JSON."""
    torch.set_num_threads(threads)
    found: dict[str, Any] = {}
    if what == "seconds":
        if program == "deeplens":
            found |= deeplens_seconds(count)
        else:
            found |= dolens_seconds(count, program == WHOLE)
    else:
        spot = {"reference": reference, "dolens": dolens_error, "deeplens": deeplens_error}[program]
        found |= {str(angle): spot(angle, count).tolist() for angle in (0.0, 2.0)}
    found["megabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(found))


def run(program: str, what: str, count: int, path: str | None, threads: int) -> dict[str, Any]:
    """Run one measurement in a process of its own."""
    command = [sys.executable, "-P", __file__, "--child", program, what, str(count), str(threads)]
    paths = [p for p in (path, os.environ.get("PYTHONPATH")) if p]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1]}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def main() -> None:
    """Measure what is asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--deeplens", help="directory that holds the package deeplens")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--count", type=int, default=1024, help="pixels a side, for times")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(*given.child[:2], *map(int, given.child[2:]))
        return
    programs = ["dolens", *(["deeplens"] if given.deeplens else [])]
    exact = run("reference", "error", 512, None, given.threads)
    print("largest error over the peak, 512 pixels a side, on the axis and at 2 degrees:")
    for program in programs:
        found = run(program, "error", 512, given.deeplens, given.threads)
        if "error" in found:
            print(f"  {program}: {found['error']}")
            continue
        worst = [
            np.abs(np.array(found[a]) - np.array(exact[a])).max() / np.array(exact[a]).max()
            for a in ("0.0", "2.0")
        ]
        print(f"  {program}: {worst[0]:.2g} {worst[1]:.2g}, {found['megabytes']:.0f} MB")
    print(
        f"{len(FIELDS)} fields, {len(WAVES)} wavelengths, {given.count} pixels a side, and "
        "gradients:"
    )
    programs.insert(1, WHOLE)
    times: dict[str, list[dict[str, Any]]] = {program: [] for program in programs}
    for _ in range(given.repeats):
        for program in programs:
            found = run(program, "seconds", given.count, given.deeplens, given.threads)
            times[program].append(found)
            print(f"  {program}: {times[program][-1]}", flush=True)
    for program, rows in times.items():
        good = [row for row in rows if "seconds" in row]
        if good:
            seconds = [row["seconds"] for row in good]
            print(
                f"{program}: median {np.median(seconds):.1f} s, least {min(seconds):.1f} s, of "
                f"processors {np.median([row['processor_seconds'] for row in good]):.1f} s, "
                f"{max(row['megabytes'] for row in good):.0f} MB"
            )


if __name__ == "__main__":
    main()
