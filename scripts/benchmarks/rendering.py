"""The 256×256, 49-sample RGB render through the wavefront-coding lens, and its gradient."""

import torch
from torch import Tensor

from benchmarks.cases import load
from benchmarks.results import Results, Row
from benchmarks.timing import Contender, by_turns
from benchmarks.tracing import Plan, ratio_to
from dolens import Lens
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

RENDER, RENDER_GRADIENT = "render", "render and gradient"
LENS = "wavefront_coding"
WIDTH, WIDTH_MM, SAMPLES = 256, 1.7664, 7


def texture(pixels: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(1, 3, H, W): smooth waves, the same picture at every resolution."""
    u = torch.linspace(0, 1, pixels + 2, dtype=torch.float64)
    waves = [torch.sin(9 * u[:, None] + k) * torch.cos(7 * u[None, :] - k) for k in range(3)]
    return (0.5 + 0.4 * torch.stack(waves))[None].to(device=device, dtype=dtype)


def measure(results: Results, plan: Plan, pixels: int = WIDTH) -> None:
    """Rows of milliseconds an image; the error is the RMS difference over the reference's image."""
    for part in (RENDER, RENDER_GRADIENT):
        for dtype in plan.dtypes:
            for threads in plan.threads:
                torch.set_num_threads(threads)
                _compare(results, plan, part, dtype, threads, pixels)


def _image(lens: Lens, pixels: int, seed: int, textures: Tensor) -> Tensor:
    sensor = Sensor(pixels, pixels, WIDTH_MM / pixels)
    scene = PlanarScene([6000.0], [656.2725, 587.5618, 486.1327])
    return RayRenderer(sensor, SAMPLES).render(lens, scene, textures, seed)


def _gradient(lens: Lens, pixels: int, seed: int, textures: Tensor) -> dict[str, Tensor]:
    """Return the gradient of the mean squared image: plate's coefficients and texture."""
    lens.zero_grad(set_to_none=True)
    leaf = textures.detach().requires_grad_()
    _image(lens, pixels, seed, leaf).square().mean().backward()
    found = {n: p.grad for n, p in lens.named_parameters() if p.grad is not None}
    return found | {"texture": leaf.grad}


def _difference(found: dict[str, Tensor], expected: dict[str, Tensor]) -> tuple[float, str]:
    """Largest relative difference by norm, and whose it is."""
    pairs = {n: (found[n].cpu().double(), e.cpu().double()) for n, e in expected.items()}
    return max(
        (float((a - b).norm() / b.norm().clamp(min=1e-300)), n) for n, (a, b) in pairs.items()
    )


def _compare(
    results: Results, plan: Plan, part: str, dtype: torch.dtype, threads: int, pixels: int
) -> None:
    gradient = part == RENDER_GRADIENT
    textures = texture(pixels, dtype, plan.device)

    def quantities(lens: Lens, seed: int, textures: Tensor) -> dict[str, Tensor]:
        if gradient:
            return _gradient(lens, pixels, seed, textures)
        with torch.no_grad():
            return {"image": _image(lens, pixels, seed, textures)}

    lenses = {backend: load(LENS, dtype, backend, plan.device) for backend in plan.backends}
    for lens in lenses.values():
        lens.requires_grad_(gradient)
    timings = by_turns(
        [
            Contender(backend, lambda lens=lens: quantities(lens, 1, textures))
            for backend, lens in lenses.items()
        ],
        plan.seconds,
        plan.device,
        least=2,
    )
    # Backends may draw other samples: the difference of two seeds says what that alone makes.
    exact = load(LENS, torch.float64, "reference", plan.device).requires_grad_(gradient)
    expected = quantities(exact, 1, textures.double())
    noise, _ = _difference(quantities(exact, 2, textures.double()), expected)
    for backend, timing in timings.items():
        row = {
            "part": part,
            "lens": LENS,
            "backend": backend,
            "device": plan.device.type,
            "dtype": str(dtype)[6:],
            "threads": threads,
            "rays": pixels * pixels * SAMPLES**2 * 3,
            **timing.columns(1e3, "ms"),
        }
        if not timing.failure:
            error, where = _difference(quantities(lenses[backend], 1, textures), expected)
            row |= ratio_to(timing, timings["reference"])
            row |= {"error": error, "error_unit": "relative", "error_against": "float64 reference"}
            row["note"] = f"{pixels}×{pixels}, {where}; another seed alone: {noise:.1e}"
        results.add(Row(**row))
