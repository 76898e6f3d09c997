import pytest
import torch

from dolens.errors import InputError
from dolens.imaging.color import linear_to_srgb
from dolens.reconstruction import UNetRestoration, WienerUNetRestoration, wiener_deconvolve


def raw_image(dtype=torch.float32):
    return torch.rand(2, 3, 18, 21, generator=torch.Generator().manual_seed(0), dtype=dtype)


def point_spread_functions(depths=2, dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    psf = torch.rand(depths, 3, 5, 5, generator=generator, dtype=dtype)
    psf[:, :, 2, 2] += 20
    return psf / psf.sum(dim=(-2, -1), keepdim=True)


def test_only_the_wiener_network_asks_for_point_spread_functions():
    assert UNetRestoration.needs_point_spread_function is False
    assert WienerUNetRestoration.needs_point_spread_function is True


def test_the_unet_begins_as_the_encoded_image():
    raw = raw_image()
    assert torch.equal(UNetRestoration(width=4, depth=2)(raw, None), linear_to_srgb(raw))


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
    for network in (UNetRestoration(4, 2), WienerUNetRestoration(4, 2, margin=4)):
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
