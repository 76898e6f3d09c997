"""Errors against tests/reference: rays traced in 28 digits."""

import json
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dolens import Rays, Status
from dolens.optics.elements import POSE
from dolens.prescriptions import lens_from_prescription, load_prescription

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tests" / "reference" / "rays"
STATUS = {"ok": Status.OK, "vignetted": Status.VIGNETTED, "tir": Status.TIR, "miss": Status.MISSED}
# The reference's lens and ours.
LENSES = {
    "asphere_initial": "asphere",
    "largefov": "large_fov_doublet",
    "triplet": "cooke_triplet",
    "wfc_cubic_1e-4": "wavefront_coding",
}
# Ours and the reference's file.
FILES = {ours: FOLDER / f"rays_{name}__dfc.json" for name, ours in LENSES.items()}


@torch.no_grad()
def reference_error(
    path: Path, dtype: torch.dtype, backend: str = "auto", device: torch.device | str = "cpu"
) -> tuple[float, float, int]:
    """Largest error of a sensor point, mm, of valid rays and of all that arrive, vignetted ones
    too; and how many statuses differ.
    """
    data = json.loads(path.read_text(encoding="utf-8"))
    rays, file = data["rays"], ROOT / "conf" / "lens" / f"{LENSES[data['lens']]}.yaml"
    prescription = load_prescription(file) | {"elements": _elements(data)}
    lens = lens_from_prescription(prescription, dtype, data["index_model"])
    if "cubic" in data["lens"]:
        lens.surfaces["5"].x3.fill_(1e-4)
        lens.surfaces["5"].y3.fill_(1e-4)
    lens.backend = backend
    lens = lens.to(device)
    position, direction = (_numbers(ray[key] for ray in rays).to(device) for key in ("o", "d"))
    wavelength = torch.tensor([float(ray["wavelength"]) for ray in rays], dtype=torch.float64)
    hit = lens.trace(Rays(position, direction, wavelength.to(device)))
    sensor = _numbers(ray["sensor"] or (0, 0, 0) for ray in rays)
    error = (hit.position.cpu().double() - sensor).norm(dim=-1)
    valid = torch.tensor([ray["valid"] for ray in rays])
    arrives = torch.tensor([ray["status"] in ("ok", "vignetted") for ray in rays])
    status = torch.tensor([int(STATUS[ray["status"]]) for ray in rays])
    differ = int((hit.status.cpu() != status).sum())
    return float(error[valid].max()), float(error[arrives].max()), differ


def _elements(data: dict) -> dict:
    """The file's poses as a prescription writes them."""
    elements = {}
    for name, pose in data.get("pose", {"elements": {}})["elements"].items():
        numbers = [float(value) for value in (*pose["theta_deg"], *pose["shift"])]
        elements[name] = {"surfaces": pose["surfaces"], **dict(zip(POSE, numbers, strict=True))}
    return elements


def golden_error(
    name: str, dtype: torch.dtype, backend: str, device: torch.device
) -> tuple[float, int]:
    """Largest error of a valid ray's sensor point, mm, and how many statuses differ.

    NaN and 0 for a lens that has no reference rays.
    """
    if name not in FILES:
        return float("nan"), 0
    error, _, differ = reference_error(FILES[name], dtype, backend, device)
    return error, differ


def golden_point_error(
    name: str, dtype: torch.dtype, wavelength: float, sensor_points: Callable[[Rays], Tensor]
) -> float:
    """Largest distance, mm, of any program's points on the sensor from those of the reference's
    valid rays of one wavelength (nm).

    NaN for a lens that has no reference rays.
    """
    if name not in FILES:
        return float("nan")
    every = json.loads(FILES[name].read_text(encoding="utf-8"))["rays"]
    rays = [ray for ray in every if ray["valid"] and float(ray["wavelength"]) == wavelength]
    position, direction, sensor = (
        _numbers(ray[key] for ray in rays) for key in ("o", "d", "sensor")
    )
    found = sensor_points(Rays(position.to(dtype), direction.to(dtype), wavelength))
    return float((found.detach()[:, :2].double() - sensor[:, :2]).norm(dim=-1).max())


def _numbers(rows) -> torch.Tensor:  # noqa: ANN001 - of nested decimal strings
    return torch.tensor([[float(v) for v in row] for row in rows], dtype=torch.float64)
