"""Errors against tests/reference: rays traced in 28 digits."""

import json
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dolens import Rays, Status
from dolens.prescriptions import lens_from_prescription, load_prescription

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tests" / "reference" / "rays"
STATUS = {"ok": Status.OK, "vignetted": Status.VIGNETTED, "tir": Status.TIR, "miss": Status.MISSED}
# The lens's file and its reference's.
FILES = {
    "asphere": "rays_asphere_initial__dfc.json",
    "cooke_triplet": "rays_triplet__dfc.json",
    "wavefront_coding": "rays_wfc_cubic_1e-4__dfc.json",
    "large_fov_doublet": "rays_largefov__dfc.json",
}


@torch.no_grad()
def golden_error(
    name: str, dtype: torch.dtype, backend: str, device: torch.device
) -> tuple[float, int]:
    """Largest error of a valid ray's sensor point, mm, and how many statuses differ.

    NaN and 0 for a lens that has no reference rays.
    """
    if name not in FILES:
        return float("nan"), 0
    data = _reference(name)
    rays = data["rays"]
    lens = lens_from_prescription(
        load_prescription(ROOT / "conf" / "lens" / f"{name}.yaml"), dtype, data["index_model"]
    )
    if name == "wavefront_coding":
        lens.surfaces["5"].x3.fill_(1e-4)
        lens.surfaces["5"].y3.fill_(1e-4)
    lens.backend = backend
    lens = lens.to(device)
    position, direction = (_numbers(ray[key] for ray in rays).to(device) for key in ("o", "d"))
    wavelength = torch.tensor([float(ray["wavelength"]) for ray in rays], dtype=torch.float64)
    hit = lens.trace(Rays(position, direction, wavelength.to(device)))
    sensor = _numbers(ray["sensor"] or (0, 0, 0) for ray in rays)
    valid = torch.tensor([ray["valid"] for ray in rays])
    status = torch.tensor([int(STATUS[ray["status"]]) for ray in rays])
    error = (hit.position.cpu().double() - sensor).norm(dim=-1)[valid].max()
    return float(error), int((hit.status.cpu() != status).sum())


def golden_point_error(
    name: str, dtype: torch.dtype, wavelength: float, sensor_points: Callable[[Rays], Tensor]
) -> float:
    """Largest distance, mm, of any program's points on the sensor from those of the reference's
    valid rays of one wavelength (nm).

    NaN for a lens that has no reference rays.
    """
    if name not in FILES:
        return float("nan")
    rays = [
        ray
        for ray in _reference(name)["rays"]
        if ray["valid"] and float(ray["wavelength"]) == wavelength
    ]
    position, direction, sensor = (
        _numbers(ray[key] for ray in rays) for key in ("o", "d", "sensor")
    )
    found = sensor_points(Rays(position.to(dtype), direction.to(dtype), wavelength))
    return float((found.detach()[:, :2].double() - sensor[:, :2]).norm(dim=-1).max())


def _reference(name: str) -> dict:
    return json.loads((FOLDER / FILES[name]).read_text(encoding="utf-8"))


def _numbers(rows) -> torch.Tensor:  # noqa: ANN001 - of nested decimal strings
    return torch.tensor([[float(v) for v in row] for row in rows], dtype=torch.float64)
