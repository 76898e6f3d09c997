"""Networks from images to images: U-Net, pyramid of a backbone's features, and NAFNet."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import FeaturePyramid, NAFNet, UNet, load_backbone
from tests.reconstruction.scenes import left_start


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(1)


def pyramid(stages=2, channels=3, out_channels=3, pyramid_channels=8, zero_output=False):
    backbone = load_backbone("mobilenet_v2", channels, stages, 0.25, weights="none")
    return FeaturePyramid(backbone, out_channels, pyramid_channels, zero_output)


def image(height, width, channels=3, batch=1):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(
        batch, channels, height, width, generator=generator, dtype=torch.float64
    ).float()


def inception():
    return FeaturePyramid(load_backbone("googlenet", 6, 5, weights="none"), 2, 8)


# From six channels to two, each by its number of halvings or stages.
NETWORKS = {
    "U-Net, 1": lambda: UNet(6, 2, width=4, depth=1),
    "U-Net, 3": lambda: UNet(6, 2, width=4, depth=3),
    "pyramid, 2": lambda: pyramid(2, 6, 2),
    "pyramid, 3": lambda: pyramid(3, 6, 2),
    "pyramid, 5": lambda: pyramid(5, 6, 2),
    "pyramid of Inception": inception,
}


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (32, 32), (17, 31), (40, 9)])
@pytest.mark.parametrize("name", NETWORKS)
def test_keeps_any_image_size_and_its_input_also_when_training_on_one_image(name, size):
    batch = image(*size, channels=6)
    output = NETWORKS[name]()(batch)
    assert output.shape == (1, 2, *size)
    assert output.isfinite().all()
    assert torch.equal(batch, image(*size, channels=6))


@pytest.mark.parametrize("name", ["U-Net, 3", "pyramid, 3"])
def test_padding_repeats_the_edge(name):
    network, small = NETWORKS[name]().eval(), image(13, 10, channels=6)
    extended = torch.cat([small, small[:, :, -1:].expand(1, 6, 3, 10)], dim=2)
    extended = torch.cat([extended, extended[..., -1:].expand(1, 6, 16, 6)], dim=3)
    torch.testing.assert_close(network(small), network(extended)[..., :13, :10])


def unet(zero_output):
    return UNet(6, 3, width=4, depth=2, zero_output=zero_output)


MADE = {
    "U-Net": unet,
    "pyramid, 2": lambda zero_output: pyramid(2, 6, 3, 16, zero_output),
    "pyramid, 5": lambda zero_output: pyramid(5, 6, 3, 16, zero_output),
}


@pytest.mark.parametrize("name", MADE)
def test_a_zero_output_is_zero_an_ordinary_start_is_not_and_every_parameter_learns(name):
    batch = image(64, 64, channels=6, batch=2)
    assert MADE[name](False)(batch).abs().max() > 1e-3
    network = MADE[name](True)
    assert not network(batch).any()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    target = batch[:, :3].roll(2, -1)
    largest = dict.fromkeys(dict(network.named_parameters()), 0.0)
    for _ in range(4):  # the output's weights first, then what stands before them, …
        optimizer.zero_grad()
        (network(batch) - target).square().mean().backward()
        optimizer.step()
        for parameter_name, parameter in network.named_parameters():
            largest[parameter_name] = max(
                largest[parameter_name], parameter.grad.abs().max().item()
            )
    assert [parameter_name for parameter_name, value in largest.items() if value == 0] == []


def test_the_gradient_is_that_of_finite_differences():
    network = pyramid(3).double()
    batch = image(17, 20).double().requires_grad_()
    network(batch).square().sum().backward()
    generator = torch.Generator().manual_seed(3)
    direction = torch.randn(batch.shape, generator=generator, dtype=torch.float64)
    step = 1e-6
    with torch.no_grad():
        ahead, behind = (
            network(batch + sign * step * direction).square().sum() for sign in (1, -1)
        )
    slope = (ahead - behind) / (2 * step)
    torch.testing.assert_close((batch.grad * direction).sum(), slope, rtol=1e-5, atol=0)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: UNet(3, 3, depth=0), "depth=0"),
        (lambda: UNet(3, 3, width=0), "width=0"),
        (lambda: UNet(0, 3), "in_channels=0"),
        # More halvings than any photograph allows.
        (lambda: UNet(3, 3, depth=10**12), "UNet depth=1000000000000: .* at most 16"),
        (lambda: pyramid(pyramid_channels=0), "pyramid_channels=0: must be a positive multiple"),
        (lambda: pyramid(pyramid_channels=-4), "pyramid_channels=-4"),
        (lambda: pyramid(pyramid_channels=6), "pyramid_channels=6"),
    ],
)
def test_impossible_sizes_are_refused_by_name(make, said):
    with pytest.raises(InputError, match=said):
        make()


# ---------------------------------------------------------------- U-Net


def test_stages_double_their_channels_and_every_3x3_is_normalised_and_rectified():
    network = UNet(3, 3, width=16, depth=3)
    kinds = [type(module) for module in network.modules() if not list(module.children())]
    convolutions = [module for module in network.modules() if isinstance(module, nn.Conv2d)]
    assert [c.out_channels for c in convolutions[:8]] == [16, 16, 32, 32, 64, 64, 128, 128]
    assert len(convolutions) == 4 * 2 + 3 * 3 + 1
    assert kinds == [nn.Conv2d, nn.BatchNorm2d, nn.ReLU] * 17 + [nn.Conv2d]
    assert convolutions[-1].kernel_size == (1, 1)


def test_the_coarsest_stage_sees_far_and_the_skip_sees_near():
    network = UNet(1, 1, width=4, depth=3).double().eval()
    batch = torch.rand(1, 1, 64, 64, dtype=torch.float64, requires_grad=True)
    network(batch)[0, 0, 32, 32].backward()
    reach = batch.grad[0, 0].abs()
    assert reach[32, 32] > 0
    # Three levels of two 3×3 convolutions up to the third halving reach ±28 pixels and more.
    assert reach[32, :16].max() > 0


def test_channels_last_gives_the_same_and_stays_channels_last():
    network = UNet(3, 3, width=8, depth=2).eval()
    batch = torch.rand(2, 3, 16, 24)
    expected = network(batch)
    network.to(memory_format=torch.channels_last)
    output = network(batch.contiguous(memory_format=torch.channels_last))
    assert output.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(output, expected)


# ---------------------------------------------------------------- pyramid


def test_the_output_is_the_pyramid_of_its_equations():
    network = pyramid(stages=4).double()
    batch = image(32, 48).double()

    def twice(features, times=1):
        factor = 2**times
        return features.repeat_interleave(factor, -1).repeat_interleave(factor, -2)

    def convolved(layer, features):
        return functional.conv2d(
            features, layer.weight, layer.bias, padding=layer.kernel_size[0] // 2
        )

    def smooth(block, features):
        values = convolved(block[0], features)
        return torch.maximum(values, 0.2 * values)

    c = network.backbone(batch)
    lateral = [convolved(network.finest_lateral, c[1])]
    lateral += [convolved(layer, f) for layer, f in zip(network.laterals, c[2:], strict=True)]
    p4 = lateral[3]
    p3 = smooth(network.smoothings[0], lateral[2] + twice(p4))
    p2 = smooth(network.smoothings[1], lateral[1] + twice(p3))
    heads = [
        twice(smooth(head[1], smooth(head[0], level)), times)
        for times, (head, level) in enumerate(zip(network.heads, (p2, p3, p4), strict=True))
    ]
    merged = smooth(network.merge, torch.cat(heads, dim=1))
    refined = smooth(network.refine, twice(merged) + lateral[0])
    finished = torch.cat([twice(refined), c[0]], dim=1)
    for block in network.finish:
        finished = smooth(block, finished)
    torch.testing.assert_close(network(batch), convolved(network.output, finished))
    assert [layer.out_channels for layer in network.laterals] == [8, 8, 8]
    assert (merged.shape[1], refined.shape[1]) == (4, 2)


def test_a_shift_by_the_stride_shifts_the_output():
    """Statistics over the image's area would not let it: its content is not the same."""
    network = pyramid(2).double()
    wide = image(96, 108).double()
    left, right = network(wide[..., :96]), network(wide[..., 12:])
    middle = (..., slice(36, -36), slice(36, -36))
    assert left[middle].std() > 1e-3
    torch.testing.assert_close(left[..., 36:-36, 48:-36], right[..., 36:-36, 36:-48])


def test_training_and_evaluation_agree_and_images_of_a_batch_do_not_meet():
    network, batch = pyramid(3).double(), image(24, 40, batch=3).double()
    training = network.train()(batch)
    evaluation = network.eval()(batch)
    assert torch.equal(training, evaluation)
    torch.testing.assert_close(network(batch[1:2]), evaluation[1:2])


# ---------------------------------------------------------------- NAFNet


def test_without_channel_attention_a_nafnet_looks_at_the_surroundings_alone():
    image = torch.rand(1, 3, 64, 64)
    changed = image.clone()
    changed[..., -4:, -4:] += 1.0
    for attention, same in ((False, True), (True, False)):
        network = left_start(NAFNet(3, 3, 4, (1,), 1, (1,), 2, attention))
        near = network(image)[..., :8, :8], network(changed)[..., :8, :8]
        assert torch.equal(*near) == same
