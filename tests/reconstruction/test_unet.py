import pytest
import torch
from torch import nn

from dolens.errors import InputError
from dolens.reconstruction import GlobalDiscriminator, UNet


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(1)


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (16, 16), (17, 31), (40, 9)])
@pytest.mark.parametrize("depth", [1, 3])
def test_keeps_any_image_size_also_when_training_on_one_image(size, depth):
    output = UNet(2, 5, width=4, depth=depth)(torch.rand(1, 2, *size))
    assert output.shape == (1, 5, *size)
    assert output.isfinite().all()


def test_zero_output_is_zero_and_an_ordinary_start_is_not():
    image = torch.rand(2, 3, 16, 16)
    assert torch.equal(
        UNet(3, 3, width=4, depth=2, zero_output=True)(image), torch.zeros(image.shape)
    )
    assert UNet(3, 3, width=4, depth=2)(image).abs().max() > 1e-3


def test_a_zero_output_network_learns():
    network = UNet(1, 1, width=4, depth=2, zero_output=True)
    optimizer = torch.optim.SGD(network.parameters(), lr=0.1)
    image = torch.rand(2, 1, 16, 16)
    for _ in range(2):
        optimizer.zero_grad()
        (network(image) - 1.0).square().mean().backward()
        optimizer.step()
    assert all(parameter.grad.abs().max() > 0 for parameter in network.parameters())


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
    image = torch.rand(1, 1, 64, 64, dtype=torch.float64, requires_grad=True)
    network(image)[0, 0, 32, 32].backward()
    reach = image.grad[0, 0].abs()
    assert reach[32, 32] > 0
    # Three levels of two 3×3 convolutions up to the third halving reach ±28 pixels and more.
    assert reach[32, :16].max() > 0


def test_padding_repeats_the_edge():
    network = UNet(1, 1, width=4, depth=2).eval()
    image = torch.rand(1, 1, 13, 10)
    extended = torch.cat([image, image[:, :, -1:].expand(1, 1, 3, 10)], dim=2)
    extended = torch.cat([extended, extended[..., -1:].expand(1, 1, 16, 2)], dim=3)
    torch.testing.assert_close(network(image), network(extended)[..., :13, :10])


def test_channels_last_gives_the_same_and_stays_channels_last():
    network = UNet(3, 3, width=8, depth=2).eval()
    image = torch.rand(2, 3, 16, 24)
    expected = network(image)
    network.to(memory_format=torch.channels_last)
    output = network(image.contiguous(memory_format=torch.channels_last))
    assert output.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(output, expected)


def test_leaves_its_input_alone():
    image = torch.rand(1, 3, 9, 9)
    before = image.clone()
    UNet(3, 3, width=4, depth=1)(image)
    assert torch.equal(image, before)


@pytest.mark.parametrize("wrong", [{"depth": 0}, {"width": 0}, {"in_channels": 0}])
def test_sizes_below_one_are_refused_by_name(wrong):
    arguments = {"in_channels": 3, "out_channels": 3, **wrong}
    with pytest.raises(InputError, match=f"{next(iter(wrong))}=0"):
        UNet(**arguments)


def test_more_halvings_than_any_photograph_allows_are_refused():
    with pytest.raises(InputError, match=r"UNet depth=1000000000000: .* at most 16"):
        UNet(3, 3, depth=10**12)
    with pytest.raises(InputError, match=r"discriminator halvings=17: .* at most 16"):
        GlobalDiscriminator(halvings=17)
