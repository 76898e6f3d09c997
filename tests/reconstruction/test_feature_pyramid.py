import pytest
import torch
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import FeaturePyramid, load_backbone


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


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (32, 32), (33, 64)])
@pytest.mark.parametrize("stages", [2, 3, 5])
def test_keeps_any_image_size(size, stages):
    output = pyramid(stages, channels=6, out_channels=2)(image(*size, channels=6))
    assert output.shape == (1, 2, *size)
    assert output.isfinite().all()


@pytest.mark.parametrize("size", [(1, 1), (13, 70)])
def test_an_inception_backbone_keeps_any_image_size(size):
    network = FeaturePyramid(load_backbone("googlenet", stages=5, weights="none"), 3, 8)
    assert network(image(*size)).shape == (1, 3, *size)


def test_zero_output_is_zero_and_an_ordinary_start_is_not():
    batch = image(16, 16)
    assert torch.equal(pyramid(zero_output=True)(batch), torch.zeros(batch.shape))
    assert pyramid()(batch).abs().max() > 1e-2


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


@pytest.mark.parametrize("stages", [2, 5])
def test_every_parameter_learns_from_a_zero_output(stages):
    network = pyramid(stages, channels=6, pyramid_channels=16, zero_output=True)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    batch = image(64, 64, channels=6, batch=2)
    target = batch[:, :3].roll(2, -1)
    largest = dict.fromkeys(dict(network.named_parameters()), 0.0)
    for _ in range(4):  # the output's weights first, then what stands before them, …
        optimizer.zero_grad()
        (network(batch) - target).square().mean().backward()
        optimizer.step()
        for name, parameter in network.named_parameters():
            largest[name] = max(largest[name], parameter.grad.abs().max().item())
    assert [name for name, value in largest.items() if value == 0] == []


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


def test_padding_repeats_the_edge():
    network = pyramid(3)
    small = image(13, 10)
    extended = torch.cat([small, small[:, :, -1:].expand(1, 3, 3, 10)], dim=2)
    extended = torch.cat([extended, extended[..., -1:].expand(1, 3, 16, 6)], dim=3)
    torch.testing.assert_close(network(small), network(extended)[..., :13, :10])


def test_leaves_its_input_alone():
    batch = image(9, 9)
    pyramid()(batch)
    assert torch.equal(batch, image(9, 9))


@pytest.mark.parametrize("wrong", [0, -4, 6])
def test_channels_that_cannot_be_quartered_are_refused(wrong):
    with pytest.raises(InputError, match=f"pyramid_channels={wrong}: must be a positive multiple"):
        pyramid(pyramid_channels=wrong)
