"""Measure the errors of dolens: of reference rays, and of the registration of the ground truth.

python scripts/accuracy.py
"""

import torch
from benchmarks.golden import FOLDER, ROOT, reference_error

from dolens import load_lens
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor


def reference_rays() -> None:
    """Largest error of a sensor point against every reference file, in both precisions."""
    print("reference rays: largest error of a sensor point, mm; statuses that differ")
    for path in sorted(FOLDER.glob("*.json")):
        cells = []
        for dtype in (torch.float64, torch.float32):
            _, error, differ = reference_error(path, dtype)
            cells.append(f"{str(dtype)[6:]} {error:.1e} ({differ})")
        print(f"  {path.stem:32s}", "  ".join(cells))


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


if __name__ == "__main__":
    reference_rays()
    registration()
