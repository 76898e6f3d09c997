"""Measure the errors of dolens: of reference rays, and of the registration of the ground truth.

python scripts/accuracy.py
"""

import json
from pathlib import Path

import torch

from dolens import Rays, Status, load_lens
from dolens.optics.elements import POSE
from dolens.prescriptions import lens_from_prescription, load_prescription
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor

ROOT = Path(__file__).resolve().parents[1]
LENSES = {
    "asphere_initial": "asphere",
    "largefov": "large_fov_doublet",
    "triplet": "cooke_triplet",
    "wfc_cubic_1e-4": "wavefront_coding",
}
STATUS = {"ok": Status.OK, "vignetted": Status.VIGNETTED, "tir": Status.TIR, "miss": Status.MISSED}


@torch.no_grad()
def reference_rays() -> None:
    """Largest error of a sensor point against every reference file, in both precisions."""
    print("reference rays: largest error of a sensor point, mm; statuses that differ")
    for path in sorted((ROOT / "tests/reference/rays").glob("*.json")):
        data = json.loads(path.read_text(encoding="utf-8"))
        rays = data["rays"]
        sensor = _tensor([ray["sensor"] or (0, 0, 0) for ray in rays])
        arrives = torch.tensor([ray["status"] in ("ok", "vignetted") for ray in rays])
        status = torch.tensor([STATUS[ray["status"]] for ray in rays])
        wavelength = _tensor([ray["wavelength"] for ray in rays])
        cells = []
        for dtype in (torch.float64, torch.float32):
            file = ROOT / "conf/lens" / f"{LENSES[data['lens']]}.yaml"
            prescription = load_prescription(file) | {"elements": _elements(data)}
            lens = lens_from_prescription(prescription, dtype, data["index_model"])
            if "cubic" in data["lens"]:
                lens.surfaces["5"].x3.fill_(1e-4)
                lens.surfaces["5"].y3.fill_(1e-4)
            position, direction = (_tensor([ray[key] for ray in rays]) for key in ("o", "d"))
            hit = lens.trace(Rays(position, direction, wavelength))
            error = (hit.position.double() - sensor).norm(dim=-1)[arrives].max()
            differ = int((hit.status != status).sum())
            cells.append(f"{str(dtype)[6:]} {float(error):.1e} ({differ})")
        print(f"  {path.stem:32s}", "  ".join(cells))


def _elements(data: dict) -> dict:
    """The file's poses as a prescription writes them."""
    elements = {}
    for name, pose in data.get("pose", {"elements": {}})["elements"].items():
        numbers = [float(value) for value in (*pose["theta_deg"], *pose["shift"])]
        elements[name] = {"surfaces": pose["surfaces"], **dict(zip(POSE, numbers, strict=True))}
    return elements


def registration() -> None:
    """Offset of the rendered image from the pinhole's over the 256×256 sensor, in pixels.

    The plain lens images ramps on 8×8 blocks of 32 pixels; a ramp's offset is the shift itself.
    """
    print("registration of the ground truth, pixels: centre | largest over the field, by colour")
    lens = load_lens(ROOT / "conf/lens/wavefront_coding.yaml").requires_grad_(False)
    block = 32
    sensor = Sensor(256 // block, 256 // block, 0.0069 * block)
    size = sensor.width + 2
    ramp = torch.arange(size, dtype=torch.float64)
    renderer = RayRenderer(sensor, 24, pixel_area=False)
    for depth in (8000.0, 6000.0, 4500.0):
        scene = PlanarScene([depth], [656.2725, 587.5618, 486.1327])
        shifts = []
        for texture in (ramp[None, :].expand(size, size), ramp[:, None].expand(size, size)):
            texture = texture.expand(1, 3, size, size)
            image = renderer.render(lens, scene, texture, seed=2)
            white = renderer.render(lens, scene, torch.ones_like(texture), seed=2)
            shifts.append(((image / white)[:, 0] - pinhole_image(texture, sensor))[0] * block)
        length = torch.stack(shifts).square().sum(0).sqrt()
        centre = torch.stack(shifts)[..., 3:5, 3:5].mean((-1, -2)).square().sum(0).sqrt()
        colours = ("red", "green", "blue")
        text = ", ".join(
            f"{name} {float(centre[c]):.3f} | {float(length[c].max()):.3f}"
            for c, name in enumerate(colours)
        )
        print(f"  {depth / 1000:g} m: {text}")


def _tensor(rows: list) -> torch.Tensor:
    """Nested decimal strings as a float64 tensor."""
    return torch.tensor(
        [[float(v) for v in row] if isinstance(row, list | tuple) else float(row) for row in rows],
        dtype=torch.float64,
    )


if __name__ == "__main__":
    reference_rays()
    registration()
