"""The supplement's lenses as prescribed: first-order data, layouts, and errors of their trace.

`python -m dolens.experiments.report.prescriptions FOLDER` writes a run folder.
"""

import copy
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.report.plan import FOLDER
from dolens.experiments.running.run_files import INFO, METRICS, write_json
from dolens.experiments.running.run_folder import describe_run, peak_memory_mb
from dolens.files import packaged_configuration
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.plotting import layout_figure, save_figure
from dolens.prescriptions import (
    lens_from_prescription,
    load_lens,
    load_prescription,
    prescription_of,
)

_NM_PER_MM = 1e6
_PRECISIONS = {"float64": torch.float64, "float32": torch.float32}


def load_golden_rays() -> list[dict[str, Any]]:
    """Return the bundles of golden_rays.json.

    Each has `name`, `lens` (a file of conf/lens), `elements` and `values` (what is changed of it),
    and `rays`: `o` and `d` (mm, at launch), `wavelength` (nm) and `sensor` (x and y, mm), from a
    trace with 28 significant digits.
    """
    return json.loads((FOLDER / "golden_rays.json").read_text(encoding="utf-8"))["bundles"]


@torch.no_grad()
def trace_errors(bundles: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the largest distance of a sensor point from the exact one, nm.

    Returns:
        `trace_error_nm/<bundle>` in double precision and `trace_error_nm/float32/<bundle>` in
        single; `trace_rays` counts the rays of all bundles.
    """
    numbers: dict[str, float] = {}
    for bundle in bundles:
        rays = bundle["rays"]
        exact = _tensor([ray["sensor"] for ray in rays])
        for precision, dtype in _PRECISIONS.items():
            lens = golden_lens(bundle, dtype)
            position, direction = (_tensor([ray[key] for ray in rays]) for key in ("o", "d"))
            wavelength = _tensor([ray["wavelength"] for ray in rays])
            hit = lens.trace(Rays(position, direction, wavelength))
            error = (hit.position[:, :2].double() - exact).norm(dim=-1).max()
            infix = "" if precision == "float64" else f"{precision}/"
            numbers[f"trace_error_nm/{infix}{bundle['name']}"] = _NM_PER_MM * float(error)
    numbers["trace_rays"] = float(sum(len(bundle["rays"]) for bundle in bundles))
    return numbers


def golden_lens(bundle: Mapping[str, Any], dtype: torch.dtype) -> Lens:
    """Return the lens of a bundle."""
    file = packaged_configuration() / "lens" / f"{bundle['lens']}.yaml"
    prescription = load_prescription(file) | {"elements": bundle["elements"]}
    lens = lens_from_prescription(prescription, dtype, where=file.name)
    with torch.no_grad():
        for name, value in bundle["values"].items():
            lens.variables([name])[name].fill_(value)
    return lens


def _tensor(rows: Sequence[Any]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


MODULE = "dolens.experiments.report.prescriptions"
_LINE_NM = 587.5618
_TIMED_RAYS = 100_000
_TIMES = 9


@dataclass(frozen=True)
class Shown:
    """How a lens is drawn.

    Attributes:
        lens: its file in conf/lens.
        fields: of the layout, degrees.
        object_distance: mm, or None for an object at infinity.
        tilt_x: of the whole lens, degrees.
    """

    lens: str
    fields: tuple[float, ...] = (0.0,)
    object_distance: float | None = None
    tilt_x: float = 0.0


SHOWN = (
    Shown("asphere"),
    Shown("nikon", (0.0, 10.0, 20.0, 32.45)),
    Shown("nikon_optimized", (0.0, 10.0, 20.0, 32.45)),
    Shown("cooke_triplet", (0.0, 14.0, 20.0)),
    Shown("wavefront_coding", (0.0, 0.5), 6000.0),
    Shown("large_fov_doublet", (0.0, 14.0, 20.0)),
    Shown("double_gauss", (0.0, 15.4, 22.0)),
    Shown("lb1757", tilt_x=10.0),
    Shown("la1509", object_distance=864.0),
)


def main(folder: Path) -> None:
    """Measure the lenses, draw them, and write the run folder.

    Args:
        folder: run.json, metrics.json and figures/ are written there.
    """
    started = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    info = {**describe_run(0, "cpu", "float64", sys.argv), "module": MODULE}
    numbers = trace_errors(load_golden_rays())
    prescribed = packaged_configuration() / "lens"
    for shown in SHOWN:
        lens = load_lens(prescribed / f"{shown.lens}.yaml", dtype=torch.float64)
        first_order = lens.first_order(_LINE_NM)
        numbers[f"efl_mm/{shown.lens}"] = float(first_order.efl.detach())
        numbers[f"bfd_mm/{shown.lens}"] = float(first_order.bfd.detach())
        save_figure(layout(lens, shown), folder / "figures" / f"layout_{shown.lens}.png")
    numbers |= trace_costs(load_lens(prescribed / "cooke_triplet.yaml"))
    numbers["cost/wall_s"] = time.perf_counter() - started
    numbers["cost/peak_memory_mb"] = peak_memory_mb(torch.device("cpu"))
    write_json(folder / METRICS, numbers)
    write_json(folder / INFO, {**info, "status": "finished"})


def layout(lens: Lens, shown: Shown) -> Figure:
    """Return the section of a lens with its rays."""
    wavelength = lens.reference_wavelength or _LINE_NM
    if shown.tilt_x:
        values = {"elements.lens.tilt_x": torch.tensor(shown.tilt_x).deg2rad()}
        return layout_figure(_as_element(lens).with_values(values), wavelength, shown.fields)
    return layout_figure(lens, wavelength, shown.fields, object_distance=shown.object_distance)


def trace_costs(lens: Lens) -> dict[str, float]:
    """Return the time of a trace of many rays, ns per ray and surface, without and with gradient.

    Args:
        lens: any lens; single precision is its own choice.
    """
    generator = torch.Generator().manual_seed(0)
    radius = 0.4 * float(lens.surfaces["1"].semi_diameter)
    across = radius * (2.0 * torch.rand(_TIMED_RAYS, 2, generator=generator) - 1.0)
    position = torch.cat((across, torch.full((_TIMED_RAYS, 1), -10.0)), dim=1)
    rays = Rays(position, torch.tensor([[0.0, 0.0, 1.0]]), _LINE_NM)
    held = copy.deepcopy(lens).requires_grad_(False)

    def with_gradient() -> None:
        lens.trace(rays).position.sum().backward()

    scale = 1e9 / (_TIMED_RAYS * len(lens.surfaces))
    return {
        "cost/trace_ns_per_ray_and_surface": scale * _least(lambda: held.trace(rays)),
        "cost/gradient_ns_per_ray_and_surface": scale * _least(with_gradient),
        "cost/rays": float(_TIMED_RAYS),
    }


def _least(call: Callable[[], object]) -> float:
    """Return the least of several times, s; the first call may compile."""
    call()
    times = []
    for _ in range(_TIMES):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return min(times)


def _as_element(lens: Lens) -> Lens:
    """Return the lens with all its surfaces in one element."""
    surfaces = [1, len(lens.surfaces)]
    prescription = {**prescription_of(lens), "elements": {"lens": {"surfaces": surfaces}}}
    return lens_from_prescription(prescription, lens.dtype)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
