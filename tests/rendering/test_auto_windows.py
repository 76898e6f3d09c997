"""A renderer chosen for windows of a large sensor: its errors, elsewhere on the sensor too."""

import copy
import logging
import math

import pytest
import torch

from dolens import load_lens
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.probes import GREY_LEVEL, fine_detail, probe_image
from dolens.rendering.chief_ray_map import chief_ray_maps
from dolens.rendering.exit_pupil import axial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.protocol import SensorWindow
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
WHOLE, SIDE = Sensor(1142, 1142, 0.03), 64
SENSOR = Sensor(SIDE, SIDE, WHOLE.pixel_pitch)
SCENE = PlanarScene((1e6,), LINES)


@pytest.fixture
def doublet(root):
    lens = load_lens(root / "conf/lens/large_fov_doublet.yaml", dtype=torch.float32)
    return lens.requires_grad_(False)


def at(share):
    """The window at a share of the way from the middle to a corner."""
    start = round((0.5 + 0.5 * share) * (WHOLE.height - SIDE))
    return WHOLE.window(start, start, SIDE, SIDE)


@pytest.fixture(scope="module")
def chosen():
    """The windows with a renderer that was chosen for them: one choice for all tests that ask."""
    found = {}

    def choose(lens, tolerance, shares=(0.0, 0.5, 0.75, 1.0)):
        if (tolerance, shares) not in found:
            auto = AutoRenderer(SENSOR, tolerance)
            windows = auto.for_windows(WHOLE, {f"{share:g}": at(share) for share in shares})
            windows.prepare(lens, SCENE)
            found[tolerance, shares] = windows
        return copy.deepcopy(found[tolerance, shares])

    return choose


def measured(lens, renderer, window):
    """RMS error of a window in grey levels against rays, on the worse of two images: one like a
    photograph, and one of fine detail.
    """
    size = (SIDE + 64, SIDE + 64, 5)
    textures = (probe_image(*size), fine_detail(*size))
    return max(measured_on(texture, lens, renderer, window) for texture in textures)


def measured_on(texture, lens, renderer, window):
    system = lens.double().system()
    pupil, middle = axial_exit_pupil(system, LINES[1:2]), PlanarScene(SCENE.depths, LINES[1:2])
    (look,) = chief_ray_maps(ImagingSystem(system, middle, WHOLE, pupil), [window])
    lens.float()
    centre = tuple(float(c.mean().round()) for c in look)
    image = renderer.render_windows(lens, SCENE, texture, [SensorWindow(window, centre)], seed=11)[
        0
    ]
    scene = PlanarScene(SCENE.depths, LINES, centre)
    one, two = (
        RayRenderer(window, 24).render(lens, scene, texture, seed)[0].double() for seed in (1, 2)
    )
    noise = 0.25 * (one - two).square().mean()
    squared = (image - 0.5 * (one + two)).square().mean() - noise
    return math.sqrt(max(float(squared), 0.0)) / GREY_LEVEL


@pytest.mark.parametrize("tolerance", [4.0, 1.0])
def test_windows_elsewhere_err_no_more_than_they_may(doublet, chosen, tolerance):
    """On other windows and another image than the plan was measured on, by rays."""
    renderer = chosen(doublet, tolerance).choice.renderer
    for share in (0.2, 0.6, 0.9):
        assert measured(doublet, renderer, at(share)) <= tolerance


def test_the_errors_that_are_said_are_those_that_are_found(doublet, chosen):
    """Of the same windows with another image: to a third."""
    windows = chosen(doublet, 4.0)
    for name, error in windows.choice.errors.items():
        assert measured(doublet, windows.choice.renderer, at(float(name))) == pytest.approx(
            error, rel=0.33
        )


def test_less_tolerance_costs_more(doublet, chosen):
    coarse, fine = (chosen(doublet, t).choice.renderer for t in (4.0, 0.5))
    assert coarse.rays_per_image(SCENE) < fine.rays_per_image(SCENE)


def test_the_edge_asks_for_more_than_the_axis(doublet, chosen):
    """So a choice for all windows has the size that the corner's function needs."""
    axis, whole = (chosen(doublet, 1.0, shares=s).choice.renderer for s in ((0.0,), (0.0, 1.0)))
    assert axis.size < whole.size


def test_a_choice_that_still_serves_is_kept_and_another_lens_gets_another(doublet, chosen, caplog):
    windows = chosen(doublet, 1.0)
    before = windows.choice.renderer
    with caplog.at_level(logging.INFO):
        windows.prepare(doublet, SCENE)
    assert "still serves" in caplog.text
    assert windows.plans == 1
    assert windows.choice.renderer == before
    # Half a millimetre out of focus: wider functions.
    defocused = {"sensor_distance": doublet.sensor_distance + 1.5}
    windows.prepare(doublet.with_values(defocused), SCENE)
    assert windows.plans == 2
    assert windows.choice.renderer.size > before.size
    assert windows.choice.error <= 1.0


def test_a_choice_outlives_a_checkpoint(doublet, chosen):
    windows = chosen(doublet, 1.0)
    again = AutoRenderer(SENSOR, 1.0).for_windows(WHOLE, windows.windows)
    again.load_state(doublet, windows.state())
    assert again.choice.renderer == windows.choice.renderer
    assert again.choice.errors == windows.choice.errors
    assert again.numbers()["auto/error_grey_levels"] == windows.choice.error


def test_a_tolerance_that_cannot_be_met_is_said(doublet, caplog):
    """On a window of 16 pixels: a choice that fails has tried everything."""
    window = at(0.5).window(24, 24, 16, 16)
    auto = AutoRenderer(Sensor(16, 16, WHOLE.pixel_pitch), 0.05)
    windows = auto.for_windows(WHOLE, {"0.5": window})
    with caplog.at_level(logging.WARNING):
        windows.prepare(doublet, SCENE)
    assert "the tolerance of 0.05 grey levels is not met" in caplog.text
    assert windows.choice.error > 0.05
