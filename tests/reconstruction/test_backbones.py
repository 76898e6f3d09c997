"""Backbones: their features are those of the trained classifiers that they were."""

import logging

import pytest
import torch
from torch import nn
from torchvision.models import googlenet, mobilenet_v2

from dolens.errors import InputError
from dolens.reconstruction import Backbone, PretrainedWeightsUnavailable, load_backbone
from dolens.reconstruction.backbones import ARCHITECTURES

MEAN = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)


DEVIATION = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)


# What torchvision's own networks are tapped at: the modules that end the stages.
TAPS = {
    "mobilenet_v2": [f"features.{number}" for number in (1, 3, 6, 13, 17)],
    "googlenet": ["conv1", "conv3", "inception3b", "inception4e", "inception5b"],
}


CHANNELS = {"mobilenet_v2": (16, 24, 32, 96, 320), "googlenet": (64, 192, 480, 832, 1024)}


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(1)


@pytest.fixture(scope="session")
def classifiers():
    """torchvision's networks with random values everywhere, as if trained."""
    with torch.random.fork_rng():
        torch.manual_seed(2)
        networks = {
            "mobilenet_v2": mobilenet_v2(),
            "googlenet": googlenet(aux_logits=False, init_weights=False, transform_input=True),
        }
        for network in networks.values():
            for part in network.modules():
                if isinstance(part, nn.Conv2d):
                    nn.init.kaiming_normal_(part.weight)
                if isinstance(part, nn.BatchNorm2d):
                    nn.init.normal_(part.running_mean, std=0.3)
                    nn.init.uniform_(part.running_var, 0.3, 2.0)
                    nn.init.uniform_(part.weight, 0.5, 1.5)
                    nn.init.normal_(part.bias, std=0.3)
    return {name: network.eval() for name, network in networks.items()}


@pytest.fixture(scope="session")
def files(classifiers, tmp_path_factory):
    folder = tmp_path_factory.mktemp("classifiers")
    for name, network in classifiers.items():
        torch.save(network.state_dict(), folder / f"{name}.pth")
    return {name: str(folder / f"{name}.pth") for name in classifiers}


def image(channels=3, batch=2, size=64):
    return torch.rand(batch, channels, size, size, generator=torch.Generator().manual_seed(0))


def assert_same(own, expected):
    """To rounding in float32, which some fifty layers add up."""
    assert expected.std() > 0.1
    assert own.shape == expected.shape
    assert (own - expected).abs().max() < 1e-4 * expected.abs().max()


@pytest.mark.parametrize("name", CHANNELS)
def test_stages_halve_the_image_and_say_their_channels(name):
    backbone = load_backbone(name, weights="none")
    features = backbone(image())
    assert backbone.channels == (3, *CHANNELS[name])
    assert backbone.stride == 32
    assert [f.shape for f in features] == [
        (2, channels, 64 // 2**k, 64 // 2**k) for k, channels in enumerate(backbone.channels)
    ]


@pytest.mark.parametrize("name", CHANNELS)
def test_trained_features_are_those_of_the_classifier(name, classifiers, files):
    """Folded statistics, normalised input and taps, against torchvision's own forward pass."""
    seen = []
    network = classifiers[name]
    hooks = [
        network.get_submodule(tap).register_forward_hook(
            lambda module, inputs, output: seen.append(output.clone())
        )
        for tap in TAPS[name]
    ]
    with torch.no_grad():
        network((image() - MEAN) / DEVIATION)
    for hook in hooks:
        hook.remove()
    backbone = load_backbone(name, weights="imagenet", weights_file=files[name])
    assert backbone.pretrained
    for own, expected in zip(backbone(image())[1:], seen, strict=True):
        assert_same(own, expected)


@pytest.mark.parametrize("name", CHANNELS)
def test_further_channels_leave_trained_features_as_they_were(name, files):
    with_coordinates, without = (
        load_backbone(name, channels, 3, weights="imagenet", weights_file=files[name])
        for channels in (6, 3)
    )
    wide = image(6)
    features = with_coordinates(wide)
    for own, expected in zip(features[1:], without(wide[:, :3])[1:], strict=True):
        assert_same(own, expected)
    sum(f.square().mean() for f in features[1:]).backward()
    first = with_coordinates.layers.get_submodule(ARCHITECTURES[name].first_convolution)
    assert (first.weight.grad[:, 3:].abs().amax(dim=(0, 2, 3)) > 0).all()  # and they can learn


@pytest.mark.parametrize("name", CHANNELS)
def test_further_channels_count_from_a_random_start(name):
    backbone = load_backbone(name, 4, 2, weights="none")
    wide = image(4)
    other = wide.clone()
    other[:, 3] = 0
    assert (backbone(wide)[1] - backbone(other)[1]).abs().max() > 0.01


@pytest.mark.parametrize("name", CHANNELS)
def test_a_random_start_neither_swells_nor_fades(name):
    values = load_backbone(name, weights="none")(image())
    assert all(0.1 < f.std() < 10 for f in values)


@pytest.mark.parametrize("name", CHANNELS)
def test_training_and_evaluation_agree_and_images_of_a_batch_do_not_meet(name, files):
    for backbone in (
        load_backbone(name, stages=4, weights="none"),
        load_backbone(name, stages=4, weights_file=files[name]),
    ):
        batch = image()
        training = backbone.train()(batch)
        state = {key: value.clone() for key, value in backbone.state_dict().items()}
        evaluation = backbone.eval()(batch)
        for a, b, alone in zip(training, evaluation, backbone(batch[:1]), strict=True):
            assert torch.equal(a, b)
            assert_same(alone, a[:1])
        assert all(torch.equal(value, state[key]) for key, value in backbone.state_dict().items())


def test_a_trained_start_s_checkpoint_fits_a_random_one(files):
    trained = load_backbone("mobilenet_v2", 6, 3, weights_file=files["mobilenet_v2"])
    other = load_backbone("mobilenet_v2", 6, 3, weights="none")
    other.load_state_dict(trained.state_dict())
    assert torch.equal(other(image(6))[-1], trained(image(6))[-1])


def test_a_narrow_backbone_takes_a_file_of_its_width(tmp_path):
    narrow = mobilenet_v2(width_mult=0.25).eval()
    torch.save(narrow.state_dict(), tmp_path / "narrow.pth")
    backbone = load_backbone(
        "mobilenet_v2",
        stages=2,
        width_multiplier=0.25,
        weights="imagenet",
        weights_file=str(tmp_path / "narrow.pth"),
    )
    expected = narrow.features[:4]((image() - MEAN) / DEVIATION)
    torch.testing.assert_close(backbone(image())[-1], expected, rtol=1e-4, atol=1e-5)


def test_no_weights_are_published_for_other_widths(caplog):
    with pytest.raises(PretrainedWeightsUnavailable, match=r"published for width_multiplier=0\.5"):
        load_backbone("mobilenet_v2", width_multiplier=0.5, weights="imagenet")
    assert not load_backbone("mobilenet_v2", 3, 2, width_multiplier=0.5).pretrained
    assert [record.levelno for record in caplog.records] == [logging.WARNING]  # and no download


@pytest.mark.parametrize("weights", ["auto", "imagenet"])
def test_a_file_of_another_network_is_an_error(weights, files):
    with pytest.raises(InputError, match=r"no features\.0\.0\.weight; not a MobileNetV2 state"):
        load_backbone("mobilenet_v2", weights=weights, weights_file=files["googlenet"])


WRONG = {
    "backbone=resnet: allowed are mobilenet_v2, googlenet": {"name": "resnet"},
    "weights=vgg: allowed are auto, imagenet, download, none": {"weights": "vgg"},
    "stages=1: must be from 2 to 5": {"stages": 1},
    "stages=6: must be from 2 to 5": {"stages": 6},
    "width_multiplier=0": {"width_multiplier": 0},
    "googlenet has only width 1": {"name": "googlenet", "width_multiplier": 0.5},
    "weights_file=a.pth: not read with weights=none": {"weights_file": "a.pth"},
    "in_channels=2: must be at least 3": {"in_channels": 2},
}


@pytest.mark.parametrize("message", WRONG)
def test_impossible_settings_are_refused_by_name(message):
    with pytest.raises(InputError, match=message):
        load_backbone(**{"name": "mobilenet_v2", "weights": "none", **WRONG[message]})


def test_leaves_its_input_and_the_weights_alone(classifiers):
    architecture = ARCHITECTURES["mobilenet_v2"]
    names = architecture.trained_parameters(2, 1.0)
    state = classifiers["mobilenet_v2"].features.state_dict()
    weights = {name: state[name].clone() for name in names}
    batch = image()
    backbone = Backbone(architecture, stages=2, weights=weights)
    with torch.no_grad():
        backbone(batch)
        for parameter in backbone.parameters():
            parameter.zero_()
    assert torch.equal(batch, image())
    assert all(torch.equal(weights[name], state[name]) for name in names)
