"""Each file of the reconstruction's groups makes what it is a choice of."""

import logging
import math

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image

from dolens.reconstruction import RelativisticDiscriminators, Restoration, RestorationLoss
from dolens.sensor.colour import linear_to_srgb
from tests.experiments.tiny_experiment import SHORT, UNPICTURED

EXPERIMENT = "experiment=wavefront_coding"


@pytest.mark.parametrize("coordinates", ["false", "true"])
@pytest.mark.parametrize("name", ["unet", "nafnet", "feature_pyramid"])
def test_networks_alone_begin_as_the_encoded_image(composed, name, coordinates, caplog):
    cfg = composed(EXPERIMENT, f"network={name}", f"network.field_coordinates={coordinates}")
    if name == "feature_pyramid":
        cfg.network.weights = "none"
    with caplog.at_level(logging.WARNING):
        network = instantiate(cfg.network)
    assert isinstance(network, Restoration) and caplog.records == []
    assert network.needs_field == (coordinates == "true")
    raw = torch.rand(1, 3, 32, 40)
    assert torch.equal(network(raw, field=torch.rand(1, 2, 32, 40)), linear_to_srgb(raw))


@pytest.mark.parametrize("coordinates", ["false", "true"])
@pytest.mark.parametrize("name", ["feature_wiener", "unrolled_splitting", "wiener_nafnet"])
def test_deconvolving_networks_take_the_camera_s_functions(composed, name, coordinates):
    cfg = composed(EXPERIMENT, f"network={name}", f"network.field_coordinates={coordinates}")
    assert cfg.network.margin == 32
    network = instantiate(cfg.network)
    assert isinstance(network, Restoration) and network.needs_point_spread_function
    assert network.needs_field == (coordinates == "true")
    functions = torch.zeros(3, 3, 65, 65)
    functions[..., 32, 32] = 1.0
    raw = torch.full((1, 3, 32, 40), 0.4)
    restored = network.eval()(raw, functions, torch.rand(1, 2, 32, 40))
    torch.testing.assert_close(restored, linear_to_srgb(raw))


@pytest.mark.parametrize(
    ("experiment", "overrides", "held", "rate"),
    [
        ("wavefront_coding", [], True, 1e-4),
        ("wavefront_coding", ["network.held=false"], False, 1e-4),
        ("wavefront_coding_refocused", [], True, 1e-4),
        ("wavefront_coding_baseline", [], False, 1e-4),  # nothing else is left to train
        ("wavefront_coding", ["network.weights=none", "network.held=false"], False, 0.002),
        ("wavefront_coding", ["network=feature_wiener"], False, 0.002),
    ],
)
def test_a_lens_is_learned_through_a_network_that_restores_already(
    composed, experiment, overrides, held, rate
):
    cfg = composed(f"experiment={experiment}", *overrides)
    network = instantiate(cfg.network)
    assert held is not any(p.requires_grad for p in network.parameters())
    assert instantiate(cfg.learning_rates).of(network).network == rate


@pytest.mark.parametrize("name", ["restoration", "deblurgan"])
def test_losses_weigh_their_terms_as_written(composed, name):
    cfg = composed(EXPERIMENT, f"loss={name}", "loss.perceptual=none", "loss.l1_weight=0.5")
    loss = instantiate(cfg.loss)
    assert isinstance(loss, RestorationLoss)
    assert loss.weights == {key: cfg.loss[f"{key}_weight"] for key in loss.weights}


def test_no_discriminator_is_none(composed):
    assert instantiate(composed(EXPERIMENT, "discriminator=none").discriminator) is None


def test_the_double_scale_discriminators_train_and_judge(composed):
    cfg = composed(EXPERIMENT, "discriminator=double_scale", "discriminator.weight=0.02")
    discriminators = instantiate(cfg.discriminator)
    assert isinstance(discriminators, RelativisticDiscriminators)
    assert discriminators.weight == 0.02
    real, fake = torch.rand(2, 2, 3, 32, 32)
    for loss in (discriminators.discriminator_loss, discriminators.generator_loss):
        assert loss(real, fake).isfinite()
    names = {name.split(".")[1] for name, _ in discriminators.named_parameters()}
    assert names == {"local", "global"}


def test_the_paper_s_doublet_trains_on_whole_sensors(trained, tmp_path):
    """The whole path of the full scale, at sizes and widths that take seconds."""
    images, generator = tmp_path / "images", np.random.default_rng(0)
    images.mkdir()
    for i in range(6):
        pixels = generator.integers(0, 256, (150, 160, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / f"{i}.png")
    metrics = trained(
        "experiment=large_fov_doublet_paper",
        f"data.root={images}",
        *("views.sensor.height=64", "views.sensor.width=64", "views.sensor.pixel_pitch=0.5"),
        *("renderer.sensor.pixel_pitch=0.5", "renderer.fields=[3,3]", "renderer.size=15"),
        "evaluation_renderer.pupil_samples=2",
        *("network.weights=none", "network.width_multiplier=0.25", "network.pyramid_channels=8"),
        "discriminator.discriminators.local.width=4",
        "discriminator.discriminators.global.width=4",
        *SHORT,
        "+trainer.max_steps=2",
        UNPICTURED,
    ).metrics
    assert math.isfinite(metrics["test/psnr_db/field"])
    assert metrics["train/adversarial"] > 0.0
