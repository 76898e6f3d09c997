"""How gradients are compared with those of rays."""

import logging
import math

import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.probes import CONTRAST, MEAN, fine_detail
from dolens.rendering.gradient_check import Agreement, agreement, gradient, gradients_of_rays
from dolens.rendering.protocol import GradientMeasure
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)


def test_equal_gradients_agree_and_opposite_ones_do_not():
    one = torch.tensor([3.0, -4.0]).double()
    same = agreement(2.0 * one, (one, one))
    assert (same.cosine, same.norm_ratio, same.noise) == (pytest.approx(1.0), 2.0, 0.0)
    assert same.error == pytest.approx(1.0)
    opposite = agreement(-one, (one, one))
    assert opposite.cosine == pytest.approx(-1.0)
    assert opposite.error == pytest.approx(2.0)


def test_the_excess_is_one_where_a_tolerance_is_just_kept():
    assert Agreement(0.95, 1.0, 0.0).excess(0.95, 0.15) == pytest.approx(1.0)
    assert Agreement(1.0, 1.15, 0.0).excess(0.95, 0.15) == pytest.approx(1.0)
    assert Agreement(0.9, 1.0, 0.0).excess(0.95, 0.15) > 1.4
    # Noise of the rays is not held against a plan.
    assert Agreement(0.9, 1.0, 0.3).excess(0.95, 0.15) < 1.0


def test_noise_of_the_image_makes_no_gradient():
    """An image v·(1 + n), n of variance σ²: the squared error's own gradient is 2v(1 + σ²)."""
    sigma, v = 0.5, torch.tensor(1.5, dtype=torch.float64, requires_grad=True)

    def render(values, seed):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(40_000, generator=generator, dtype=torch.float64)
        return values["v"] * (1.0 + sigma * noise)

    measure = GradientMeasure([v], lambda: {"v": 1.0 * v}, lambda image, *_: image.square().mean())
    naive = float(gradient(render, None, measure, (1, 2)))
    pair = gradients_of_rays(render, None, measure, 1)
    assert naive == pytest.approx(3.0 * (1.0 + sigma**2), rel=0.02)
    assert float(0.5 * (pair[0] + pair[1])) == pytest.approx(3.0, rel=0.02)


def test_fine_detail_has_the_mean_and_contrast_of_photographs():
    image = fine_detail(256, 256)
    assert float(image.mean()) == pytest.approx(MEAN, abs=0.01)
    assert float(image.std()) == pytest.approx(CONTRAST, rel=0.02)
    spectrum = torch.fft.rfft2(image[0, 0] - image[0, 0].mean()).abs().square()
    spectrum[:, 1:-1] *= 2.0
    down, across = torch.fft.fftfreq(256)[:, None].abs(), torch.fft.rfftfreq(256)[None]
    fine = spectrum[(down > 0.25) | (across > 0.25)].sum() / spectrum.sum()
    # Along each side cos²(πf), of which 1/2 + 1/π lies below a quarter.
    assert float(fine) == pytest.approx(1.0 - (0.5 + 1.0 / math.pi) ** 2, abs=0.03)


def test_a_plan_says_how_its_gradients_agree(root, caplog):
    """At the edge of a large field, by the variables that require gradients."""
    lens = load_lens(root / "conf/lens/large_fov_doublet.yaml", dtype=torch.float32)
    lens.requires_grad_(False)
    values = {
        n: p.clone().requires_grad_()
        for n, p in lens.variables(["surfaces.1.curvature", "surfaces.3.curvature"]).items()
    }
    auto = AutoRenderer(Sensor(24, 24, 0.06), 2.0, diffraction=False)
    with caplog.at_level(logging.INFO):
        auto.make_plan(lens.with_values(values), PlanarScene((1e6,), LINES))
    numbers = auto.numbers()
    assert numbers["auto/gradient_cosine"] > 0.95
    assert abs(numbers["auto/gradient_norm_ratio"] - 1.0) < 0.15 + numbers["auto/gradient_noise"]
    assert "gradients have a cosine of" in caplog.text


def test_gradient_tolerances_that_make_no_sense_are_errors():
    with pytest.raises(InputError, match="gradient_cosine must be between 0 and 1"):
        AutoRenderer(Sensor(4, 4, 0.01), gradient_cosine=1.0)
