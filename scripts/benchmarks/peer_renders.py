"""dO's render of the wavefront-coding lens and its gradient beside ours, with as many rays.

Both see one texture at 6 m through 64×64 pixels, 16 rays a pixel and colour.  Errors are RMS
differences from our float64 image of 576 rays, whose own noise the other errors hide.
"""

from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import torch
from torch import Tensor

from benchmarks.cases import load
from benchmarks.peer_programs import source_lens
from benchmarks.rendering import LENS, WIDTH_MM, texture
from benchmarks.results import Results, Row
from benchmarks.timing import Contender, by_turns
from benchmarks.tracing import beside
from dolens import Lens
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

PIXELS, SIDE, EXACT_SIDE = 64, 4, 24
DEPTH, WAVELENGTHS = 6000.0, (656.2725, 587.5618, 486.1327)
TERMS = ("x3", "x2y", "xy2", "y3")
# Where dO's list of coefficients has them.
_PLACES = {"y3": 6, "xy2": 7, "x2y": 8, "x3": 9}
_CPU = torch.device("cpu")
PART, PART_GRADIENT = "peers: render", "peers: render and gradient"


class SourceRender:
    """dO's end-to-end example: its lens, screen and sampling, with our lens's surfaces."""

    def __init__(self, lens: Lens, textures: Tensor) -> None:
        import diffoptics

        self._model = source_lens(lens)
        sensor = self._model.d_sensor
        self._model.d_sensor = torch.tensor(sensor)
        self._model.prepare_mts(WIDTH_MM / PIXELS, [PIXELS, PIXELS])
        texels = textures.shape[-1]
        scale = PlanarScene([DEPTH], WAVELENGTHS).magnifications(lens.system())[0]
        size = (texels - 1) * WIDTH_MM / PIXELS / scale
        # Behind the reversed lens, whose sensor is at 0; x down its rows, y along its columns.
        place = np.array([0.0, 0.0, sensor + DEPTH])
        self._textures = [channel.flip(0).T.contiguous() for channel in textures[0]]
        self._screen = diffoptics.Screen(
            diffoptics.Transformation(np.eye(3), place), np.array([size, size]), self._textures[0]
        )

    def image(self) -> Tensor:
        """(3, H, W), oriented as ours."""
        images = []
        for wavelength, channel in zip(WAVELENGTHS, self._textures, strict=True):
            self._screen.update_texture(channel)
            total, count = 0.0, 0.0
            for _ in range(SIDE**2):
                valid, ray = self._model.sample_ray_sensor(wavelength)
                uv, on_screen = self._screen.intersect(ray)[1:]
                seen = valid & on_screen
                total = total + self._screen.shading(uv, seen)
                count = count + seen
            image = (total / (count + 1e-10)).reshape(PIXELS, PIXELS)
            images.append(image.flip(1))
        return torch.stack(images)

    def gradient(self) -> Tensor:
        """Return the gradient of the mean squared image with respect to the plate's cubic terms."""
        plate = self._model.surfaces[0]
        plate.ai = plate.ai.detach().requires_grad_()
        self.image().square().mean().backward()
        # The reversed lens has the plate's terms with the other sign.
        return torch.stack([-plate.ai.grad[_PLACES[name]] for name in TERMS])


def measure(results: Results, seconds: float, threads: int) -> None:
    """Rows of milliseconds an image; the gradient is that of the plate's four cubic terms."""
    textures = texture(PIXELS, torch.float32, _CPU)
    lens = load(LENS, torch.float32, "cpu", _CPU)
    exact = load(LENS, torch.float64, "cpu", _CPU)
    np.random.seed(1)
    torch.manual_seed(1)
    with redirect_stdout(StringIO()):
        theirs = SourceRender(lens, textures)

    def plain(run: Callable[[], Tensor]) -> Callable[[], Tensor]:
        def without() -> Tensor:
            with torch.no_grad():
                return run()

        return without

    runs = {
        PART: {"cpu": plain(lambda: _image(lens, textures, SIDE, 1)), "dO": plain(theirs.image)},
        PART_GRADIENT: {
            "cpu": lambda: _gradient(lens, textures, SIDE, 1),
            "dO": theirs.gradient,
        },
    }
    double = textures.double()
    with torch.no_grad():
        expected = {PART: _image(exact, double, EXACT_SIDE, 7)}
    seeds = [_gradient(exact, double, EXACT_SIDE, seed) for seed in range(4)]
    expected[PART_GRADIENT] = torch.stack(seeds).mean(0)
    for part, contenders in runs.items():
        timings = by_turns([Contender(k, run) for k, run in contenders.items()], seconds, _CPU)
        for name, timing in timings.items():
            row = Row(
                part,
                LENS,
                name,
                dtype="float32",
                threads=threads,
                rays=PIXELS**2 * SIDE**2 * len(WAVELENGTHS),
                **timing.columns(1e3, "ms"),
            )
            if not timing.failure:
                found = contenders[name]().double()
                error = float((found - expected[part]).norm() / expected[part].norm())
                more = {"error": error, "error_unit": "relative", "error_against": "float64"}
                row = Row(**vars(row) | more | beside(timing, timings["cpu"]))
            results.add(row)


def _image(lens: Lens, textures: Tensor, side: int, seed: int) -> Tensor:
    """(3, H, W)."""
    sensor = Sensor(PIXELS, PIXELS, WIDTH_MM / PIXELS)
    scene = PlanarScene([DEPTH], WAVELENGTHS)
    return RayRenderer(sensor, side).render(lens, scene, textures, seed)[0, 0]


def _gradient(lens: Lens, textures: Tensor, side: int, seed: int) -> Tensor:
    """Return the gradient as `SourceRender.gradient` does."""
    lens.requires_grad_(False)
    plate = lens.surfaces["5"]
    leaves = [getattr(plate, name).requires_grad_() for name in TERMS]
    loss = _image(lens, textures, side, seed).square().mean()
    return torch.stack([g.detach() for g in torch.autograd.grad(loss, leaves)])
