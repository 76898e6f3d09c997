import pytest
import torch
from torch.nn import functional
from torchvision.models import mobilenet_v2

from dolens.errors import InputError
from dolens.reconstruction import (
    FeaturePyramidRestoration,
    UNetRestoration,
    WienerUNetRestoration,
    wiener_deconvolve,
)
from dolens.sensor.colour import linear_to_srgb

SMALL = {"weights": "none", "stages": 2, "width_multiplier": 0.25, "pyramid_channels": 8}


def raw_image(dtype=torch.float32):
    return torch.rand(2, 3, 18, 21, generator=torch.Generator().manual_seed(0), dtype=dtype)


def point_spread_functions(depths=2, dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    psf = torch.rand(depths, 3, 5, 5, generator=generator, dtype=dtype)
    psf[:, :, 2, 2] += 20
    return psf / psf.sum(dim=(-2, -1), keepdim=True)


def field_of(raw):
    """Coordinates with the sensor's centre in the middle of the image."""
    height, width = raw.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    field = torch.stack([0.5 * (width - 1) - x, y - 0.5 * (height - 1)])
    return (2 * field / (height**2 + width**2) ** 0.5).expand(len(raw), 2, height, width)


def with_coordinates(kind):
    if kind == "unet":
        return UNetRestoration(width=4, depth=2, field_coordinates=True)
    return FeaturePyramidRestoration(**SMALL, field_coordinates=True)


def test_only_the_wiener_network_asks_for_point_spread_functions():
    assert UNetRestoration.needs_point_spread_function is False
    assert FeaturePyramidRestoration.needs_point_spread_function is False
    assert WienerUNetRestoration.needs_point_spread_function is True


@pytest.mark.parametrize("backbone", ["mobilenet_v2", "googlenet"])
def test_networks_alone_begin_as_the_encoded_image(backbone):
    raw = raw_image()
    pyramid = FeaturePyramidRestoration(backbone, 3, weights="none")
    for network in (UNetRestoration(width=4, depth=2), pyramid):
        assert torch.equal(network(raw, None), linear_to_srgb(raw))


def test_field_coordinates_are_asked_for_by_choice():
    assert not UNetRestoration(4, 1).needs_field
    assert not WienerUNetRestoration(4, 1).needs_field
    assert not FeaturePyramidRestoration(**SMALL).needs_field
    assert with_coordinates("unet").needs_field
    assert with_coordinates("pyramid").needs_field


@pytest.mark.parametrize("kind", ["unet", "pyramid"])
def test_the_network_is_told_x_y_and_the_squared_radius(kind):
    raw, network = raw_image(), with_coordinates(kind)
    seen = []
    network.network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    field = field_of(raw)
    restored = network(raw, field=field.double())
    assert torch.equal(restored, linear_to_srgb(raw))  # the start is the identity here too
    assert torch.equal(seen[0][:, :3], linear_to_srgb(raw))
    torch.testing.assert_close(seen[0][:, 3:5], field)
    torch.testing.assert_close(seen[0][:, 5], field[:, 0] ** 2 + field[:, 1] ** 2)


@pytest.mark.parametrize("kind", ["unet", "pyramid"])
def test_what_is_learned_may_depend_on_the_field(kind):
    torch.manual_seed(0)
    raw, network = raw_image(), with_coordinates(kind)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    field = field_of(raw)
    target = linear_to_srgb(raw) + 0.1 * field[:, :1]
    for _ in range(20):
        optimizer.zero_grad()
        (network(raw, field=field) - target).square().mean().backward()
        optimizer.step()
    network.eval()
    difference = network(raw, field=field) - network(raw, field=-field)
    assert (difference * field[:, :1]).mean() > 0  # the sign of x is what it learned


@pytest.mark.parametrize("kind", ["unet", "pyramid"])
def test_without_the_field_that_it_needs_a_network_says_so(kind):
    raw, network = raw_image(), with_coordinates(kind)
    with pytest.raises(InputError, match=f"{type(network).__name__} with field_coordinates=true"):
        network(raw)
    with pytest.raises(InputError, match=r"field of shape \(2, 2, 21, 18\)"):
        network(raw, field=field_of(raw).mT)


def test_a_field_that_is_not_needed_is_ignored():
    raw = raw_image()
    for network in (UNetRestoration(4, 1).eval(), FeaturePyramidRestoration(**SMALL)):
        assert torch.equal(network(raw, field=field_of(raw)), network(raw))


def test_a_network_tells_whether_it_began_trained(tmp_path):
    narrow = mobilenet_v2(width_mult=0.25).state_dict()
    torch.save(narrow, tmp_path / "narrow.pth")
    trained = {**SMALL, "weights": "imagenet", "weights_file": str(tmp_path / "narrow.pth")}
    raw = raw_image()
    for coordinates in (False, True):
        network = FeaturePyramidRestoration(**trained, field_coordinates=coordinates)
        assert network.pretrained
        assert torch.equal(network(raw, field=field_of(raw)), linear_to_srgb(raw))
    assert not FeaturePyramidRestoration(**SMALL).pretrained
    assert not UNetRestoration(4, 1).pretrained


def blurred_and_sharp():
    """Random discs and their image through a small blur, in linear light."""
    generator = torch.Generator().manual_seed(4)
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")
    sharp = torch.full((4, 3, 48, 48), 0.2)
    for image in sharp:
        for _ in range(12):
            row, column, radius = (
                torch.rand(3, generator=generator) * torch.tensor([48, 48, 8.0])
            ).tolist()
            color = torch.rand(3, 1, 1, generator=generator)
            image[:] = torch.where((y - row) ** 2 + (x - column) ** 2 < radius**2, color, image)
    return functional.avg_pool2d(sharp, 3, stride=1, padding=1, count_include_pad=False), sharp


@pytest.mark.parametrize("backbone", ["mobilenet_v2", "googlenet"])
def test_the_pyramid_learns_to_undo_a_blur(backbone):
    torch.manual_seed(0)
    blurred, sharp = blurred_and_sharp()
    network = FeaturePyramidRestoration(backbone, 2, pyramid_channels=16, weights="none")
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    losses = []
    for _ in range(25):
        optimizer.zero_grad()
        loss = (network(blurred) - linear_to_srgb(sharp)).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    start = (linear_to_srgb(blurred) - linear_to_srgb(sharp)).square().mean().item()
    assert losses[0] == pytest.approx(start)
    assert losses[-1] < 0.87 * start


def test_the_wiener_network_begins_as_the_deconvolution_with_the_mean_over_depths():
    raw, psf = raw_image(), point_spread_functions()
    network = WienerUNetRestoration(width=4, depth=2, margin=6, noise_to_signal=0.03)
    expected = linear_to_srgb(wiener_deconvolve(raw, psf.mean(dim=0), 0.03, margin=6))
    torch.testing.assert_close(network(raw, psf), expected)
    first_depth = linear_to_srgb(wiener_deconvolve(raw, psf[0], 0.03, margin=6))
    assert (first_depth - expected).abs().max() > 1e-3


def test_the_network_sees_both_the_deconvolved_and_the_raw_image():
    raw, psf = raw_image(), point_spread_functions()
    network = WienerUNetRestoration(width=4, depth=1, margin=4)
    seen = []
    network.network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    output = network(raw, psf)
    assert seen[0].shape == (2, 6, 18, 21)
    torch.testing.assert_close(seen[0][:, :3], output)
    torch.testing.assert_close(seen[0][:, 3:], linear_to_srgb(raw))


def test_without_point_spread_functions_the_wiener_network_says_what_it_needs():
    with pytest.raises(InputError, match="needs the lens's point spread functions, got None"):
        WienerUNetRestoration(width=4, depth=1)(raw_image(), None)
    with pytest.raises(InputError, match=r"shape \(3, 5, 5\): expected \(depths, 3, K, K\)"):
        WienerUNetRestoration(width=4, depth=1)(raw_image(), point_spread_functions()[0])


@pytest.mark.parametrize("network_dtype", [torch.float32, torch.float64])
def test_a_float64_lens_stands_before_a_network_of_any_dtype_and_gets_its_gradient(network_dtype):
    raw = (0.1 + 0.8 * raw_image(torch.float64)).requires_grad_()
    psf = point_spread_functions(dtype=torch.float64).requires_grad_()
    networks = (UNetRestoration(4, 2), WienerUNetRestoration(4, 2, margin=4))
    for network in (*networks, FeaturePyramidRestoration(**SMALL)):
        raw.grad = psf.grad = None
        restored = network.to(network_dtype)(raw, psf)
        restored.square().mean().backward()
        assert restored.dtype == network_dtype
        assert restored.shape == raw.shape
        assert raw.grad.abs().max() > 0 and raw.grad.dtype == torch.float64
        if network.needs_point_spread_function:
            assert psf.grad.abs().max() > 0 and psf.grad.isfinite().all()
            assert (network.log_noise_to_signal.grad != 0).all()


def test_the_noise_to_signal_ratio_is_a_parameter_per_colour():
    network = WienerUNetRestoration(width=4, depth=1, noise_to_signal=1e-2)
    ratio = dict(network.named_parameters())["log_noise_to_signal"].exp()
    torch.testing.assert_close(ratio, torch.full((3,), 1e-2))


@pytest.mark.parametrize("wrong", [{"noise_to_signal": 0.0}, {"margin": -1}])
def test_impossible_settings_are_refused_by_name(wrong):
    name, value = next(iter(wrong.items()))
    with pytest.raises(InputError, match=f"{name}={value}"):
        WienerUNetRestoration(width=4, depth=1, **wrong)


def test_arguments_are_left_alone():
    raw, psf = raw_image(), point_spread_functions()
    before = raw.clone(), psf.clone()
    WienerUNetRestoration(width=4, depth=1, margin=4)(raw, psf)
    assert torch.equal(raw, before[0]) and torch.equal(psf, before[1])
