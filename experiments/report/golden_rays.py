"""Rays of four lenses of the supplement, traced exactly by other programs, and our errors."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dolens.experiments.report.plan import FOLDER
from dolens.files import packaged_configuration
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.prescriptions import lens_from_prescription, load_prescription

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
