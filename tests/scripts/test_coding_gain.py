"""Gains of cameras for an extended depth of field over the best plain lens."""

import math

import pytest
import torch

from dolens.reconstruction import GeneralRestoration, psnr_db
from scripts.coding import cameras
from scripts.coding.cameras import DepthCamera, Range, Shot, best_of, bound_of, noise_of, refined
from scripts.coding.judged import MARGIN, SIDE, Motion, images_of
from scripts.coding_gain import bounds

NEAR = Range((8000.0, 6000.0, 4500.0))


def test_linear_bounds_find_the_textbook_s_tendencies(monkeypatch):
    # Every second focus and every third plate show them.
    monkeypatch.setattr(cameras, "_FOCI", 13)
    monkeypatch.setattr(cameras, "_CUBES", cameras._CUBES[::3])

    def plain(light):
        shot = Shot(NEAR, light)
        found = (best_of(f"plain F/{n}", shot, False) for n in ("8", "11", "16", "22"))
        return min(found, key=lambda pair: pair[1].common)[0].f_number

    # The brighter, the further a plain lens is stopped down.
    assert plain(5000.0) > plain(50.0) >= 8.0
    gains = bounds(NEAR, (50.0, 5000.0), ("cubic",))["cubic"]
    # Where the depth is known a plate gains more, and the more so the brighter it is.
    assert gains[1][1] > gains[0][1] > gains[0][0]
    # One plane needs no plate: the weakest is best, and gains nothing.
    one = Shot(Range((5760.0,)), 1000.0)
    camera, error = best_of("cubic", one, False)
    assert camera.plate["x3"] == 0.5e-5
    assert error.common >= best_of("plain F/8", one, False)[1].common


def test_readouts_at_one_focus_are_one_exposure_that_pays_read_noise_as_often():
    thrice = DepthCamera("bracket of 3", 8.0, (95.86,) * 3)
    once = DepthCamera("plain F/8", 8.0, (95.86,))
    assert noise_of(thrice, Shot(NEAR, 300.0)) == pytest.approx((0.01, 9.0e-4))
    for read in (0.0, 3.0):
        # The mean of three has three times the read noise's variance.
        alone = bound_of(once, Shot(NEAR, 300.0, math.sqrt(3.0) * read))
        assert bound_of(thrice, Shot(NEAR, 300.0, read)) == pytest.approx(alone, rel=1e-4)


def test_free_foci_are_better_than_those_that_they_begin_with():
    camera = DepthCamera("bracket of 2", 8.0, (95.5, 96.1))
    shot = Shot(NEAR, 1000.0)
    found, error = refined(camera, shot, True)
    assert error.each < bound_of(camera, shot).each
    assert found.family == "learned bracket of 2" and found.foci[0] < found.foci[1]


def test_a_bracket_restores_what_one_focus_loses_and_ignored_motion_costs():
    generator = torch.Generator().manual_seed(0)
    side = SIDE + 2 * MARGIN
    noise = torch.fft.rfft2(torch.randn(1, 3, side, side, generator=generator))
    down, right = torch.fft.fftfreq(side)[:, None], torch.fft.rfftfreq(side)
    light = torch.fft.irfft2(noise / (down**2 + right**2 + 1e-4).sqrt(), s=(side, side))
    scenes = (0.35 + 0.12 * light / light.std()).clamp(0.02, 1.0)
    network = GeneralRestoration(by_depth=True).eval()

    def score(camera, motion=None):
        found = images_of(camera, Shot(NEAR, 1000.0), 0, scenes, network, motion)
        return float(psnr_db(found.restored, found.truth).mean())

    bracket = DepthCamera("bracket of 3", 8.0, (95.3, 95.82, 96.29))
    still = score(bracket)
    assert still > score(DepthCamera("plain F/11", 11.0, (95.82,))) + 1.0
    ignored = score(bracket, Motion(1.0, "ignored"))
    assert still - 0.5 < score(bracket, Motion(1.0, "estimated")) > ignored + 1.0
