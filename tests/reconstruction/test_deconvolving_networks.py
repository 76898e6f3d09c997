"""Networks behind a deconvolution of opponent colours begin as it, NAFNets as the identity."""

import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import (
    FeatureWienerRestoration,
    NAFNet,
    NAFNetRestoration,
    UnrolledSplittingRestoration,
    WienerNAFNetRestoration,
    opponent_wiener_deconvolve,
)
from dolens.reconstruction.feature_wiener import NOISE_TO_SIGNAL
from dolens.sensor.colour import linear_to_srgb
from tests.reconstruction.test_opponent_wiener import blur, raw_image

SMALL_NAFNET = {"width": 4, "down": (1,), "middle": 1, "up": (1,)}
DECONVOLVING = {
    "features": lambda **others: FeatureWienerRestoration(
        width=4, depth=1, margin=4, features=2, scales=2, **others
    ),
    "depths": lambda **others: FeatureWienerRestoration(
        width=4, depth=1, margin=4, depths=2, **others
    ),
    "splitting": lambda **others: UnrolledSplittingRestoration(
        stages=2, width=4, depth=1, margin=4, **others
    ),
    "nafnet": lambda **others: WienerNAFNetRestoration(**SMALL_NAFNET, margin=4, **others),
}


def field_of(raw):
    batch, _, height, width = raw.shape
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
    )
    return torch.stack([x, y]).expand(batch, 2, height, width)


def left_start(network):
    """Move all parameters, so that the network is no longer what it begins as."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return network


@pytest.mark.parametrize("kind", ["features", "depths", "nafnet"])
@pytest.mark.parametrize("coordinates", [False, True])
def test_a_deconvolving_network_begins_as_the_deconvolution(kind, coordinates):
    raw, functions = raw_image().float(), blur().float()
    network = DECONVOLVING[kind](field_coordinates=coordinates)
    assert network.needs_point_spread_function and network.needs_field == coordinates
    ratios = torch.tensor(NOISE_TO_SIGNAL)
    expected = linear_to_srgb(opponent_wiener_deconvolve(raw, functions, ratios, margin=4))
    torch.testing.assert_close(network(raw, functions, field_of(raw)), expected)


def test_splitting_begins_as_its_data_steps_from_wiener_s_picture():
    raw, functions = raw_image().float(), blur().float()
    network = DECONVOLVING["splitting"]().eval()
    found = network(raw, functions)
    wiener = linear_to_srgb(
        opponent_wiener_deconvolve(raw, functions, torch.tensor(NOISE_TO_SIGNAL), margin=4)
    )
    # Each is nearer to the data, with more of the noise: sharper than the one before.
    assert found.diff(dim=-1).square().mean() > wiener.diff(dim=-1).square().mean()


@pytest.mark.parametrize("kind", DECONVOLVING)
def test_a_uniform_image_is_uniform_at_the_start_and_of_any_size(kind):
    network = DECONVOLVING[kind]().eval()
    for size in ((13, 18), (9, 31)):
        raw = torch.full((1, 3, *size), 0.3)
        restored = network(raw, blur().float())
        torch.testing.assert_close(restored, linear_to_srgb(raw), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", DECONVOLVING)
def test_gradients_reach_the_image_and_the_functions_as_differences_say(kind):
    network = left_start(DECONVOLVING[kind]()).double().eval()
    raw = (0.3 + 0.3 * raw_image(9, 10)[:1]).requires_grad_()
    functions = blur(size=3).requires_grad_()

    def loss(raw, functions):
        return network(raw, functions).square().mean()

    gradients = torch.autograd.grad(loss(raw, functions), (raw, functions))
    generator, step = torch.Generator().manual_seed(6), 1e-6
    for number, gradient in enumerate(gradients):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        moved = []
        for sign in (1.0, -1.0):
            arguments = [raw.detach(), functions.detach()]
            arguments[number] = arguments[number] + sign * step * direction
            moved.append(float(loss(*arguments)))
        difference = (moved[0] - moved[1]) / (2.0 * step)
        assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-4)
        assert difference != 0.0


@pytest.mark.parametrize("kind", DECONVOLVING)
def test_every_parameter_learns(kind):
    network = left_start(DECONVOLVING[kind]())
    raw = raw_image()  # of a lens in double precision
    network(raw, blur()).square().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())
    still = [n for n, p in network.named_parameters() if not p.grad.abs().max() > 0]
    assert not still


@pytest.mark.parametrize("kind", DECONVOLVING)
def test_what_is_needed_and_missing_is_said(kind):
    raw, functions = raw_image().float(), blur().float()
    with pytest.raises(InputError, match="needs the lens's point spread functions, got None"):
        DECONVOLVING[kind]()(raw)
    with pytest.raises(InputError, match="field_coordinates=true needs `field`"):
        DECONVOLVING[kind](field_coordinates=True)(raw, functions)


def test_the_field_is_seen():
    raw, functions = raw_image().float(), blur().float()
    for make in DECONVOLVING.values():
        network = left_start(make(field_coordinates=True)).eval()
        field = field_of(raw)
        assert not torch.equal(network(raw, functions, field), network(raw, functions, -field))


@pytest.mark.parametrize("size", [(16, 24), (13, 18)])
def test_a_nafnet_begins_as_the_identity_on_images_of_any_size(size):
    raw = torch.rand(2, 3, *size)
    network = NAFNetRestoration(**SMALL_NAFNET)
    assert torch.equal(network(raw), linear_to_srgb(raw))
    assert left_start(network)(raw).shape == raw.shape


def test_without_channel_attention_a_nafnet_looks_at_the_surroundings_alone():
    image = torch.rand(1, 3, 64, 64)
    changed = image.clone()
    changed[..., -4:, -4:] += 1.0
    for attention, same in ((False, True), (True, False)):
        network = left_start(NAFNet(3, 3, 4, (1,), 1, (1,), 2, attention))
        near = network(image)[..., :8, :8], network(changed)[..., :8, :8]
        assert torch.equal(*near) == same


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FeatureWienerRestoration(features=-1), "features=-1"),
        (lambda: FeatureWienerRestoration(scales=4), "scales=4"),
        (lambda: UnrolledSplittingRestoration(stages=0), "stages=0"),
        (lambda: NAFNetRestoration(width=0), "NAFNet width=0"),
        (lambda: NAFNetRestoration(down=(1, 1), up=(1,)), "as many stages up as down"),
    ],
)
def test_impossible_settings_are_refused_by_name(make, message):
    with pytest.raises(InputError, match=message):
        make()
