"""Restorers from sensor images to pictures: what they need, begin as, and learn."""

from functools import partial

import pytest
import torch
from torch.nn import functional
from torchvision.models import mobilenet_v2

from dolens.errors import InputError
from dolens.reconstruction import (
    FeaturePyramidRestoration,
    FeatureWienerRestoration,
    NAFNetRestoration,
    UNetRestoration,
    UnrolledSplittingRestoration,
    WienerNAFNetRestoration,
    WienerUNetRestoration,
    field_channels,
    opponent_wiener_deconvolve,
    wiener_deconvolve,
)
from dolens.reconstruction.feature_wiener import NOISE_TO_SIGNAL
from dolens.reconstruction.restoration import with_field_channels
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.pixels import Sensor
from tests.reconstruction.scenes import blur, field_of, left_start, raw_image

SMALL = {"weights": "none", "stages": 2, "width_multiplier": 0.25, "pyramid_channels": 8}


SMALL_NAFNET = {"width": 4, "down": (1,), "middle": 1, "up": (1,)}


# Restorers that see the image alone, and those that begin with a deconvolution.
ALONE = {
    "unet": lambda **others: UNetRestoration(width=4, depth=2, **others),
    "pyramid": lambda **others: FeaturePyramidRestoration(**SMALL, **others),
    "nafnet": lambda **others: NAFNetRestoration(**SMALL_NAFNET, **others),
}
DECONVOLVING = {
    "wiener": lambda **others: WienerUNetRestoration(width=4, depth=1, margin=4, **others),
    "features": lambda **others: FeatureWienerRestoration(
        width=4, depth=1, margin=4, features=2, scales=2, **others
    ),
    "depths": lambda **others: FeatureWienerRestoration(
        width=4, depth=1, margin=4, depths=2, **others
    ),
    "splitting": lambda **others: UnrolledSplittingRestoration(
        stages=2, width=4, depth=1, margin=4, **others
    ),
    "wiener_nafnet": lambda **others: WienerNAFNetRestoration(**SMALL_NAFNET, margin=4, **others),
}
RESTORERS = ALONE | DECONVOLVING
WITH_FIELD = [kind for kind in RESTORERS if kind != "wiener"]


def single():
    """An image and its point spread functions in single precision."""
    return raw_image().float(), blur().float()


@pytest.mark.parametrize("kind", RESTORERS)
def test_a_restorer_of_known_blur_says_so_and_refuses_without_it(kind):
    raw, functions = single()
    assert RESTORERS[kind]().needs_point_spread_function is (kind in DECONVOLVING)
    if kind in DECONVOLVING:
        with pytest.raises(InputError, match="needs the lens's point spread functions, got None"):
            RESTORERS[kind]()(raw, None)
        with pytest.raises(InputError, match=r"\(3, 5, 5\): expected \((depths|2), 3, K, K\)"):
            RESTORERS[kind]()(raw, functions[0])


@pytest.mark.parametrize("kind", RESTORERS)
def test_field_coordinates_are_asked_for_by_choice(kind):
    raw, functions = single()
    assert not RESTORERS[kind]().needs_field
    if kind in WITH_FIELD:
        network = RESTORERS[kind](field_coordinates=True)
        assert network.needs_field
        needs = f"{type(network).__name__} with field_coordinates=true"
        with pytest.raises(InputError, match=needs):
            network(raw, functions)
        with pytest.raises(InputError, match=r"field of shape \(2, 2, 18, 15\)"):
            network(raw, functions, field_of(raw).mT)


# ---------------------------------------------------------------- what they begin as


@pytest.mark.parametrize("coordinates", [False, True])
@pytest.mark.parametrize("kind", [*ALONE, "googlenet"])
@pytest.mark.parametrize("size", [(16, 24), (13, 18)])
def test_networks_alone_begin_as_the_encoded_image(kind, coordinates, size):
    googlenet = partial(FeaturePyramidRestoration, "googlenet", 3, weights="none")
    network = {"googlenet": googlenet, **ALONE}[kind](field_coordinates=coordinates)
    raw = raw_image(*size).float()
    assert torch.equal(network(raw, None, field_of(raw)), linear_to_srgb(raw))
    assert left_start(network)(raw, None, field_of(raw)).shape == raw.shape


def test_the_wiener_network_begins_as_the_deconvolution_with_the_mean_over_depths():
    raw, functions = single()
    network = WienerUNetRestoration(width=4, depth=2, margin=6, noise_to_signal=0.03)
    expected = linear_to_srgb(wiener_deconvolve(raw, functions.mean(dim=0), 0.03, margin=6))
    torch.testing.assert_close(network(raw, functions), expected)
    first_depth = linear_to_srgb(wiener_deconvolve(raw, functions[0], 0.03, margin=6))
    assert (first_depth - expected).abs().max() > 1e-3


@pytest.mark.parametrize("kind", ["features", "depths", "wiener_nafnet"])
@pytest.mark.parametrize("coordinates", [False, True])
def test_a_deconvolving_network_begins_as_the_deconvolution(kind, coordinates):
    raw, functions = single()
    before = raw.clone(), functions.clone()
    found = DECONVOLVING[kind](field_coordinates=coordinates)(raw, functions, field_of(raw))
    ratios = torch.tensor(NOISE_TO_SIGNAL)
    expected = opponent_wiener_deconvolve(raw, functions, ratios, margin=4)
    torch.testing.assert_close(found, linear_to_srgb(expected))
    assert torch.equal(raw, before[0]) and torch.equal(functions, before[1])


def test_splitting_begins_as_its_data_steps_from_wiener_s_picture():
    raw, functions = single()
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


# ---------------------------------------------------------------- gradients


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
            moved.append(float(loss(*arguments).detach()))
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


@pytest.mark.parametrize("network_dtype", [torch.float32, torch.float64])
def test_a_float64_lens_stands_before_a_network_of_any_dtype_and_gets_its_gradient(network_dtype):
    raw = (0.1 + 0.8 * raw_image()).requires_grad_()
    psf = blur().requires_grad_()
    for network in (make() for make in RESTORERS.values()):
        raw.grad = psf.grad = None
        restored = network.to(network_dtype)(raw, psf)
        restored.square().mean().backward()
        assert restored.dtype == network_dtype
        assert restored.shape == raw.shape
        assert raw.grad.abs().max() > 0 and raw.grad.dtype == torch.float64
        if network.needs_point_spread_function:
            assert psf.grad.abs().max() > 0 and psf.grad.isfinite().all()


# ---------------------------------------------------------------- field coordinates


def sensor_field(height, width):
    """As a caller computes it: points on the sensor over half its diagonal."""
    sensor = Sensor(height, width, pixel_pitch=0.01)
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64),
        torch.arange(width, dtype=torch.float64),
        indexing="ij",
    )
    half_diagonal = 0.5 * sensor.pixel_pitch * (height**2 + width**2) ** 0.5
    return torch.stack(sensor.positions(rows, columns))[None] / half_diagonal


def test_channels_are_x_y_and_the_squared_radius():
    field = torch.tensor([0.6, -0.8, 0.0, 0.5]).view(1, 2, 2, 1)  # points (0.6, 0), (−0.8, 0.5)
    channels = field_channels(field)
    torch.testing.assert_close(channels[:, :2], field)
    torch.testing.assert_close(channels[0, 2, :, 0], torch.tensor([0.36, 0.89]))


def test_the_squared_radius_is_the_same_in_all_corners_and_least_in_the_middle():
    radius = field_channels(sensor_field(30, 41))[0, 2]
    corners = radius[[0, 0, -1, -1], [0, -1, 0, -1]]
    torch.testing.assert_close(corners, corners[:1].expand(4))
    # The corner pixel's centre lies half a pixel inside the corner, whose radius is 1.
    expected = (29**2 + 40**2) / (30**2 + 41**2)
    torch.testing.assert_close(corners[0].item(), expected)
    assert radius.min() == radius[14:16, 20].max()


def test_the_image_keeps_its_dtype_and_its_channels():
    image, field = torch.rand(1, 4, 30, 41), sensor_field(30, 41)
    together = with_field_channels(image, field)
    assert together.dtype == torch.float32 and together.shape == (1, 7, 30, 41)
    assert torch.equal(together[:, :4], image)
    torch.testing.assert_close(together[:, 4:6], field.float())


@pytest.mark.parametrize("shape", [(2, 30, 41), (1, 2, 30, 40), (2, 2, 30, 41), (1, 3, 30, 41)])
def test_a_field_of_another_shape_is_refused(shape):
    with pytest.raises(InputError, match=r"field of shape .*must be \(1, 2, 30, 41\)"):
        with_field_channels(torch.rand(1, 3, 30, 41), torch.zeros(shape))


@pytest.mark.parametrize("kind", ["unet", "pyramid"])
def test_the_network_is_told_x_y_and_the_squared_radius(kind):
    raw, network = single()[0], ALONE[kind](field_coordinates=True)
    seen = []
    network.network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    field = field_of(raw)
    network(raw, field=field.double())
    assert torch.equal(seen[0][:, :3], linear_to_srgb(raw))
    torch.testing.assert_close(seen[0][:, 3:5], field)
    torch.testing.assert_close(seen[0][:, 5], field[:, 0] ** 2 + field[:, 1] ** 2)


@pytest.mark.parametrize("kind", WITH_FIELD)
def test_the_field_is_seen_where_it_is_asked_for_and_nowhere_else(kind):
    raw, functions = single()
    for asked in (True, False):
        network = left_start(RESTORERS[kind](field_coordinates=asked)).eval()
        field = field_of(raw)
        same = torch.equal(network(raw, functions, field), network(raw, functions, -field))
        assert same is not asked


@pytest.mark.parametrize("kind", ["unet", "pyramid"])
def test_what_is_learned_may_depend_on_the_field(kind):
    torch.manual_seed(0)
    raw, network = single()[0], ALONE[kind](field_coordinates=True)
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


# ---------------------------------------------------------------- single ones


def test_a_network_tells_whether_it_began_trained(tmp_path):
    narrow = mobilenet_v2(width_mult=0.25).state_dict()
    torch.save(narrow, tmp_path / "narrow.pth")
    trained = {**SMALL, "weights": "imagenet", "weights_file": str(tmp_path / "narrow.pth")}
    raw = single()[0]
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


def test_the_network_sees_both_the_deconvolved_and_the_raw_image():
    raw, functions = single()
    network, seen = DECONVOLVING["wiener"](), []
    network.network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    output = network(raw, functions)
    assert seen[0].shape == (2, 6, 15, 18)
    torch.testing.assert_close(seen[0][:, :3], output)
    torch.testing.assert_close(seen[0][:, 3:], linear_to_srgb(raw))


def test_the_noise_to_signal_ratio_is_a_parameter_per_colour():
    network = WienerUNetRestoration(width=4, depth=1, noise_to_signal=1e-2)
    ratio = dict(network.named_parameters())["log_noise_to_signal"].exp()
    torch.testing.assert_close(ratio, torch.full((3,), 1e-2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WienerUNetRestoration(noise_to_signal=0.0), r"noise_to_signal=0\.0"),
        (lambda: WienerUNetRestoration(margin=-1), "margin=-1"),
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
