"""Finished designs, traced again by a second ray tracer in 80-digit arithmetic.

    python scripts/retrace.py outputs/nikon/<date_time> [...] [--every 10]
    python scripts/retrace.py outputs/search_quartet/<date_time>/forms/*.yaml

The tracer of `tests/optics/exact.py` shares nothing with dolens but the meaning of a prescription.
It traces the rays of a design run's spots through `lens/final.yaml`, or of a lens file the rays of
its own fields and wavelengths through its stop, a spot to a field.  The lens is then judged by what
it finds, at some 3 ms for a ray and surface; `--every n` takes one ray in n of every spot, for both
tracers.
"""

import argparse
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens import load_lens
from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.lens import Lens
from dolens.optimize import MeritSettings
from tests.optics import exact


def main() -> None:
    """Print a line for every run folder and lens file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("designs", nargs="+", type=Path, help="run folders, or files of lenses")
    parser.add_argument("--every", type=int, default=1, help="one ray in so many of each spot")
    arguments = parser.parse_args()
    print("design | spots | rays | RMS µm | traced again µm | largest difference µm | s")
    for design in arguments.designs:
        print(" | ".join(compared(design, arguments.every)), flush=True)


def compared(design: Path, every: int) -> list[str]:
    """The row of one run folder, or of one lens file."""
    is_run = design.is_dir()
    path = design / "lens" / "final.yaml" if is_run else design
    lens = load_lens(path, dtype=torch.float64)
    spots = evaluated_spots(design, lens) if is_run else field_spots(lens)
    count = int(spots.spot.max()) + 1
    chosen = [
        ray
        for spot in range(count)
        for ray in torch.nonzero(spots.spot == spot).flatten().tolist()[::every]
    ]
    own = lens.trace(spots.rays).position[:, :2].detach()[chosen]
    started = time.perf_counter()
    values = exact.values_of(lens)
    found = [intercept(lens, values, spots, ray) for ray in chosen]
    again = torch.tensor(found, dtype=torch.float64)
    seconds = time.perf_counter() - started
    of_ray, weight = spots.spot[chosen], spots.weight[chosen]
    pairs = [rms_um(points, of_ray, weight, spots.centred) for points in (own, again)]
    return [
        f"{design.parent.name if is_run else design.name}",
        f"{count}",
        f"{len(chosen)}",
        f"{sum(pairs[0]) / count:.9g}",
        f"{sum(pairs[1]) / count:.9g}",
        f"{max(abs(a - b) for a, b in zip(*pairs, strict=True)):.1e}",
        f"{seconds:.0f}",
    ]


def evaluated_spots(folder: Path, lens: Lens) -> SpotRays:
    """The rays that the run's RMS radii are of, selected through the lens as dolens sees it."""
    config = yaml.safe_load((folder / ".hydra" / "resolved.yaml").read_text())
    settings = dict(config["evaluation"] or config["merit"])
    settings.pop("_target_")
    settings |= {"quality": "spots", "quality_options": {}, "operands": ()}
    return MeritSettings(**settings).rays(lens)


def field_spots(lens: Lens) -> SpotRays:
    """The rays of a lens's own fields and wavelengths; those of a field are one spot."""
    spots = MeritSettings(max_vignetting=1.0).rays(lens)
    shares = lens.wavelength_weights or [1.0] * len(lens.wavelengths)
    share = dict(zip(lens.wavelengths, shares, strict=True))
    weight = torch.tensor([share[w] for w in spots.wavelengths.tolist()], dtype=torch.float64)
    fields, place = torch.unique_consecutive(spots.fields, dim=0, return_inverse=True)
    first = [place.tolist().index(n) for n in range(len(fields))]
    return replace(
        spots,
        spot=place[spots.spot],
        weight=spots.weight * weight[spots.spot],
        centred=spots.centred[first],
    )


def intercept(lens: Lens, values: dict, spots: SpotRays, ray: int) -> list[float]:
    """Return the ray intercept on the sensor, mm."""
    status, _, point, *_ = exact.trace(
        lens,
        values,
        spots.rays.position[ray].tolist(),
        spots.rays.direction[ray].tolist(),
        float(spots.rays.wavelength[ray]),
    )
    if status != exact.OK:
        raise SystemExit(f"ray {ray} does not pass the lens when it is traced again")
    return [float(point[0]), float(point[1])]


def rms_um(
    points: torch.Tensor, of_ray: torch.Tensor, weight: torch.Tensor, centred: torch.Tensor
) -> list[float]:
    """RMS radius of each spot about its centroid, by the definition."""
    radii = []
    for spot in range(int(of_ray.max()) + 1):
        mine = of_ray == spot
        share = (weight[mine] / weight[mine].sum())[:, None]
        mean = torch.where(centred[spot], 0.0, (share * points[mine]).sum(0))
        radii.append(1e3 * math.sqrt(float((share * (points[mine] - mean).square()).sum())))
    return radii


if __name__ == "__main__":
    main()
