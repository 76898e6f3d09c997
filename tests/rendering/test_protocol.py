"""A renderer of a user's own: a field `sensor` and the method `render` are enough."""

from dataclasses import dataclass, replace

import torch

from dolens import load_lens
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.camera.views.fields import FieldViews
from dolens.rendering.exit_pupil import ExitPupil
from dolens.rendering.protocol import Renderer, SensorWindow
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.colour import srgb_to_linear
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

LINES = (656.2725, 587.5618, 486.1327)
WHOLE = Sensor(96, 120, 0.08)
WINDOW = Sensor(16, 20, 0.08)


@dataclass(frozen=True)
class PinholeRenderer(Renderer):
    """A camera without a lens: sharp everywhere."""

    sensor: Sensor
    gain: float = 1.0

    def render(self, lens, scene, textures, seed):
        image = self.gain * pinhole_image(textures, self.sensor, scene.texture_centre)
        return image[:, None].expand(-1, len(scene.depths), -1, -1, -1)


def textures(count=2, size=48):
    generator = torch.Generator().manual_seed(4)
    return torch.rand(count, 3, size, size, generator=generator)


def test_windows_are_rendered_one_after_the_other():
    renderer, scene = PinholeRenderer(WHOLE), PlanarScene((1e4, 2e4), LINES)
    sensors = [WHOLE.window(0, 0, 16, 20), WHOLE.window(40, 60, 16, 20)]
    windows = [SensorWindow(s, (float(s.centre_row), float(s.centre_column))) for s in sensors]
    image = renderer.render_windows(None, scene, textures(), windows, 0)
    assert image.shape == (2, 2, 3, 16, 20)
    for one, texture in zip(image, textures(), strict=True):
        # Each texture's centre lies in the middle of its window.
        assert torch.equal(one[0], texture[..., 16:32, 14:34])


def test_what_it_does_not_say_has_a_default():
    renderer, scene = PinholeRenderer(WHOLE, 0.5), PlanarScene((1e4,), LINES)
    assert renderer.on(WINDOW) == replace(renderer, sensor=WINDOW)
    assert renderer.for_windows(WHOLE, {"axis": WINDOW}) == renderer
    assert renderer.with_pupil(None, scene) is renderer.without_diffraction() is renderer
    assert renderer.settings() == {"gain": 0.5}
    assert renderer.rays_per_image(scene) == 0
    assert renderer.psf_size is None
    assert renderer.numbers() == renderer.state() == {}
    assert renderer.load_state(None, {"of": "another"}) is renderer
    renderer.prepare(None, scene)


def test_a_large_field_is_seen_through_it(root):
    lens = load_lens(root / "conf/lens/large_fov_doublet.yaml", dtype=torch.float32)
    scene = PlanarScene((1e5,), LINES)
    views = FieldViews(scene, WHOLE, PinholeRenderer(WINDOW), Readout(), truth="pinhole")
    views.prepare(lens)
    taken = views.take(lens, Shot(textures(), "test", 0))
    assert torch.allclose(taken.raw, srgb_to_linear(taken.truth), atol=1e-6)
    assert views.take(lens, Shot(textures(), "train", 0)).raw.shape == (2, 1, 3, 16, 20)
    assert views.rays() == 0


def test_rays_are_counted_for_what_is_rendered():
    scene, rays = PlanarScene((1e4,), LINES), RayRenderer(WHOLE, 3)
    assert rays.rays_per_image(scene) == WHOLE.height * WHOLE.width * 9 * 3
    assert rays.rays_per_image(scene, WINDOW) == WINDOW.height * WINDOW.width * 9 * 3
    # Functions are as many whatever the pixels.
    functions = PsfRenderer(WHOLE, (2, 2), 8)
    assert functions.rays_per_image(scene) == functions.rays_per_image(scene, WINDOW)


def test_a_pupil_that_is_kept_is_in_the_checkpoint():
    pupil = ExitPupil(10.0, 2.5, 2.0)
    kept = PsfRenderer(WHOLE, pupil=pupil)
    assert PsfRenderer(WHOLE).load_state(None, kept.state()) == kept
    assert PsfRenderer(WHOLE).state() == {}
