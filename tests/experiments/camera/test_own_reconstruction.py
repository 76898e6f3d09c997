"""Networks and losses that know nothing of dolens, in a camera; and those that do not fit."""

from functools import partial

import pytest
import torch
from torch import nn
from torch.nn import functional

from dolens.errors import InputError
from dolens.experiments.camera.reconstruction import (
    check_reconstruction,
    loss_over_views,
    loss_terms,
    restoration_of,
)
from dolens.reconstruction import Restoration, UNetRestoration, WienerUNetRestoration
from dolens.sensor.colour import linear_to_srgb
from tests.experiments.tiny_experiment import ONE_EPOCH, TINY, UNPICTURED

CAMERA = ["experiment=wavefront_coding", *TINY, ONE_EPOCH, UNPICTURED]
CONVOLUTION = {
    "_target_": "torch.nn.Conv2d",
    "in_channels": 3,
    "out_channels": 3,
    "kernel_size": 3,
    "padding": 1,
}
SIZE = (8, 12)


class Normalised(nn.Module):
    """A network with statistics, random numbers, and a frozen part of its own."""

    def __init__(self):
        super().__init__()
        self.free, self.frozen = nn.BatchNorm2d(3), nn.BatchNorm2d(3).eval()
        self.convolution = nn.LazyConv2d(3, 1)

    def forward(self, image):
        noisy = image + 0.0 * torch.rand_like(image)
        return self.convolution(self.frozen(self.free(nn.functional.dropout(noisy))))


class Told(Restoration):
    """A network that asks for everything a camera knows."""

    needs_point_spread_function = True
    needs_field = True

    def forward(self, raw, point_spread_functions=None, field=None):
        assert point_spread_functions.shape[:2] == (2, 3) and field.shape == (1, 2, *SIZE)
        assert torch.equal(point_spread_functions.sum((-1, -2)), torch.ones(2, 3))
        return linear_to_srgb(raw)


class Pair(nn.Module):
    def forward(self, image):
        return image, image


class Doubled(nn.Module):
    def forward(self, image):
        return image.double()


def signed(restored, truth):
    return -functional.l1_loss(restored, truth)


def no_total(restored, truth):
    return {"l1": functional.l1_loss(restored, truth), "l2": functional.mse_loss(restored, truth)}


def broken(restored, truth):
    return restored.reshape(7, 7)


def checked(network, loss=functional.l1_loss):
    network = restoration_of(network)
    check_reconstruction(network, loss, SIZE, 2)
    return network


def test_a_plain_convolution_and_torch_s_own_loss_train_and_are_measured(trained):
    found = trained(*CAMERA, network=CONVOLUTION, loss={"_target_": "torch.nn.L1Loss"})
    assert found.metrics["test/psnr_db/worst"] == found.objective
    assert found.metrics["network/pretrained"] == 0.0
    assert "loss/perceptual_available" not in found.metrics
    assert found.state["network.network.weight"].shape == (3, 3, 3, 3)


def test_a_lens_is_trained_alone_behind_a_network_without_parameters(trained):
    """The raw image is the restored one, and a function is the loss."""
    loss = {"_target_": "torch.nn.functional.l1_loss", "_partial_": True}
    metrics = trained(*CAMERA, network={"_target_": "torch.nn.Identity"}, loss=loss).metrics
    assert metrics["test/psnr_db"] == pytest.approx(metrics["test/raw_psnr_db"], abs=1e-6)
    assert metrics["variables/surfaces.5.x3"] != 0.0


def test_a_network_of_images_is_given_what_a_display_shows():
    network = restoration_of(nn.Identity())
    raw = torch.rand(2, 3, 4, 5)
    assert torch.equal(network(raw, None, None), linear_to_srgb(raw))
    assert network.dtype == torch.float32
    assert restoration_of(nn.Conv2d(3, 3, 1).double()).dtype == torch.float64
    own = UNetRestoration(4, 1)
    assert restoration_of(own) is own


def test_the_trial_leaves_statistics_modes_and_random_numbers_alone():
    network = Normalised()
    state = torch.random.get_rng_state()
    mean = network.free.running_mean.clone()
    checked(network)
    assert torch.equal(network.free.running_mean, mean)
    assert network.free.num_batches_tracked == 0
    assert torch.equal(torch.random.get_rng_state(), state)
    assert network.training and network.free.training and not network.frozen.training
    # Lazy parameters have their shapes before an optimizer takes them.
    assert network.convolution.weight.shape == (3, 3, 1, 1)


def test_the_trial_offers_all_that_a_network_asks_for():
    checked(Told())
    checked(WienerUNetRestoration(width=4, depth=1, margin=4))
    checked(UNetRestoration(4, 1, field_coordinates=True))


NETWORKS = {
    "other channels": (nn.Conv2d(3, 1, 1), r"Conv2d gives a tensor of shape \(1, 1, 8, 12\)"),
    "another size": (nn.MaxPool2d(2), r"needed: the same shape, torch\.float32"),
    "another type": (Doubled(), r"a tensor of shape \(1, 3, 8, 12\), torch\.float64"),
    "two images": (Pair(), "Pair gives a tuple for an image"),
    "six channels wanted": (nn.Conv2d(6, 3, 1), r"Conv2d fails on an image of shape \(1, 3, 8"),
    "no module": (functional.relu, "relu is no torch.nn.Module"),
}


@pytest.mark.parametrize("case", NETWORKS)
def test_a_network_that_does_not_fit_is_one_clear_line(case):
    network, expected = NETWORKS[case]
    with pytest.raises(InputError, match=f"^network: .*{expected}") as caught:
        checked(network)
    assert "\n" not in str(caught.value)


LOSSES = {
    "no total": (no_total, "no_total gives l1, l2 and no 'total'"),
    "a number for each pixel": (
        nn.L1Loss(reduction="none"),
        r"L1Loss gives a tensor of shape \(1, 3, 8, 12\)",
    ),
    "no tensor": (lambda restored, truth: 1.0, "gives a float as the number to be minimised"),
    "a fault": (broken, r"broken fails .* RuntimeError: .*test_own_reconstruction\.py, line \d+\)"),
}


@pytest.mark.parametrize("case", LOSSES)
def test_a_loss_that_does_not_fit_is_one_clear_line(case):
    loss, expected = LOSSES[case]
    with pytest.raises(InputError, match=f"^loss: .*{expected}") as caught:
        checked(nn.Identity(), loss)
    assert "\n" not in str(caught.value)


def test_such_a_network_is_refused_before_any_training(trained, tmp_path):
    with pytest.raises(InputError, match=r"^network: Conv2d gives a tensor of shape"):
        trained(*CAMERA, network={**CONVOLUTION, "out_channels": 6})
    assert not (tmp_path / "run/run.json").exists()


def test_a_number_and_a_mapping_with_it_are_the_same_loss():
    restored, truth = torch.rand(2, 1, 3, 4, 4)
    losses = (
        nn.L1Loss(),
        partial(functional.l1_loss, reduction="mean"),
        lambda a, b: {"total": functional.l1_loss(a, b), "constant": 2.0},
    )
    number, same, mapping = (loss_terms(loss, restored, truth) for loss in losses)
    assert number["total"] == same["total"] == mapping["total"] > 0.0
    assert float(mapping["constant"]) == 2.0


def test_the_power_mean_of_views_lies_between_their_mean_and_the_worst():
    restored, truth = torch.rand(2, 1, 3, 3, 4, 4)
    each = torch.stack([functional.l1_loss(restored[:, v], truth[:, v]) for v in range(3)])
    mean, fourth, hundredth = (
        float(loss_over_views(functional.l1_loss, restored, truth, p)["total"])
        for p in (1.0, 4.0, 100.0)
    )
    assert mean == pytest.approx(float(each.mean()), rel=1e-6)
    assert fourth == pytest.approx(float((each**4).mean() ** 0.25), rel=1e-5)
    assert mean < fourth < hundredth <= float(each.max())


def test_a_negative_loss_has_a_mean_over_views_but_no_power_mean():
    restored, truth = torch.rand(2, 1, 3, 3, 4, 4)
    found = loss_over_views(signed, restored, truth, 1.0)["total"]
    positive = loss_over_views(functional.l1_loss, restored, truth, 1.0)["total"]
    assert float(found) == pytest.approx(-float(positive), rel=1e-6)
    with pytest.raises(InputError, match="view_norm: 4 needs a loss that is not negative"):
        loss_over_views(signed, restored, truth, 4.0)
