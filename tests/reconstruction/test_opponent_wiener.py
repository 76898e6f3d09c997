"""Wiener's filter for colours that go together, and the data step of half-quadratic splitting."""

import pytest
import torch
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import opponent_wiener_deconvolve, wiener_deconvolve
from dolens.reconstruction.opponent_wiener import OPPONENT, OpponentWiener, check_functions
from dolens.reconstruction.unrolled_splitting import splitting_data_step
from tests.reconstruction.scenes import blur, raw_image

RATIOS = torch.tensor([0.02, 0.2, 0.5], dtype=torch.float64)


def blurred(picture, function):
    """A periodic image, blurred within one period."""
    half = function.shape[-1] // 2
    padded = functional.pad(picture, (half,) * 4, mode="circular")
    return functional.conv2d(padded, function.flip(-2, -1)[:, None], groups=3)


def test_opponent_colours_are_orthonormal():
    basis = torch.tensor(OPPONENT, dtype=torch.float64)
    torch.testing.assert_close(basis @ basis.T, torch.eye(3, dtype=torch.float64))


def test_equal_ratios_and_one_depth_are_the_filter_of_each_colour_by_itself():
    raw, functions = raw_image(), blur(depths=1)
    found = opponent_wiener_deconvolve(raw, functions, torch.full((3,), 0.3).double(), margin=4)
    torch.testing.assert_close(found, wiener_deconvolve(raw, functions[0], 0.3, margin=4))


def test_a_uniform_image_stays_what_it_is_in_all_its_colours():
    raw = torch.tensor([0.7, 0.2, 0.1], dtype=torch.float64)[:, None, None].expand(1, 3, 13, 17)
    for size in (5, 7):
        found = opponent_wiener_deconvolve(raw, blur(size=size), RATIOS, margin=6)
        torch.testing.assert_close(found, raw)


def test_without_noise_a_blur_of_one_depth_is_undone():
    # 16×20 pixels without a margin are one period, so that the model of the image is exact.
    picture, functions = raw_image(16, 20), blur(depths=1)
    raw = blurred(picture, functions[0])
    found = opponent_wiener_deconvolve(raw, functions, 1e-13 * RATIOS, margin=0)
    torch.testing.assert_close(found, picture, rtol=0, atol=1e-8)


def test_noise_of_colours_alone_is_averaged_where_colours_go_together():
    generator = torch.Generator().manual_seed(2)
    grey = 0.5 + 0.1 * torch.randn(4, 3, 48, 48, generator=generator, dtype=torch.float64)
    functions = torch.ones(1, 3, 1, 1, dtype=torch.float64)

    def left(ratios):
        found = opponent_wiener_deconvolve(grey, functions, torch.tensor(ratios).double(), margin=8)
        return (found - 0.5).std()

    # Luminance passes, the differences of colours do not: a third of the variance is left.
    assert left([1e-9, 1e4, 1e4]) == pytest.approx(0.1 / 3**0.5, rel=0.05)
    assert left([1e-9, 1e-9, 1e-9]) == pytest.approx(0.1, rel=0.05)


def test_the_common_filter_has_the_least_mean_error_over_the_depths():
    """Moved filters, of other mean functions, do worse than the mean of the true ones."""
    picture, functions = raw_image(32, 32), blur(depths=2)
    functions[1] = 0.0
    functions[1, :, :, 2] = 0.2  # a vertical line
    noise = 0.02 * torch.randn(picture.shape, generator=torch.Generator().manual_seed(3)).double()
    raw = [blurred(picture, function) + noise for function in functions]

    def error(given):
        found = [opponent_wiener_deconvolve(r, given, 0.05 * RATIOS, margin=0) for r in raw]
        return sum((f - picture).square().mean() for f in found)

    both, mean = error(functions), error(functions.mean(0, keepdim=True))
    assert both < mean
    assert both < error(functions[:1]) and both < error(functions[1:])


def test_a_picture_for_each_depth_is_that_of_its_own_function():
    raw, functions = raw_image(), blur(depths=3)
    wiener = OpponentWiener(4, RATIOS.tolist(), depths=3).double()
    pictures = wiener(raw, functions)
    assert pictures.shape == (2, 4, 3, 15, 18)
    ratios = wiener.log_noise_to_signal.exp()[0]
    common = opponent_wiener_deconvolve(raw, functions, ratios, margin=4)
    torch.testing.assert_close(pictures[:, 0], common)
    for depth in range(3):
        own = opponent_wiener_deconvolve(raw, functions[depth : depth + 1], ratios, margin=4)
        torch.testing.assert_close(pictures[:, 1 + depth], own)
    one = wiener(raw, functions[:1])  # as of a calibration at one depth: it stands for all
    torch.testing.assert_close(one[:, 1], one[:, 3])


def test_a_guess_that_explains_the_image_is_kept_whatever_the_penalty_is():
    picture, functions = raw_image(16, 20), blur(depths=1)
    raw = blurred(picture, functions[0])
    for penalty in (RATIOS, 1e3 * RATIOS):
        found = splitting_data_step(raw, functions, picture, penalty, margin=0)
        torch.testing.assert_close(found, picture)


def test_the_data_step_is_the_minimum_of_its_sum_of_squares():
    """By autograd on the sum itself: its gradient vanishes at the data step's x alone."""
    raw, functions, guess = raw_image(16, 20), blur(), raw_image(16, 20).flip(-1)
    x = splitting_data_step(raw, functions, guess, RATIOS, margin=0).requires_grad_()
    basis = torch.tensor(OPPONENT, dtype=torch.float64)
    down, across = (torch.fft.fftfreq(n, dtype=torch.float64) / 0.5 for n in (16, 20))
    frequency = down[:, None] ** 2 + across**2

    def gradient(x):
        data = sum((blurred(x, f) - raw).square().sum() for f in functions) / len(functions)
        change = torch.fft.fft2(torch.einsum("kc,bcij->bkij", basis, x - guess)).abs().square()
        penalty = (frequency * RATIOS[:, None, None] * change).sum() / (16 * 20)
        return torch.autograd.grad(data + penalty, x)[0].abs().max()

    assert gradient(x) < 1e-10
    assert gradient((x + 0.01).detach().requires_grad_()) > 1e-3


@pytest.mark.parametrize("step", ["deconvolution", "data step"])
def test_gradients_are_those_of_differences(step):
    raw, functions = raw_image(5, 4)[:1].requires_grad_(), blur(size=3).requires_grad_()
    ratios = RATIOS.clone().requires_grad_()
    if step == "deconvolution":
        arguments = (raw, functions, ratios)

        def call(raw, functions, ratios):
            return opponent_wiener_deconvolve(raw, functions, ratios, margin=1)
    else:
        guess = raw_image(5, 4)[:1].flip(-1).detach().requires_grad_()
        arguments = (raw, functions, ratios, guess)

        def call(raw, functions, ratios, guess):
            return splitting_data_step(raw, functions, guess, ratios, margin=1)

    assert torch.autograd.gradcheck(call, arguments)


@pytest.mark.parametrize("shape", [(3, 5, 5), (2, 3, 4, 4), (2, 3, 5, 3), (2, 1, 5, 5)])
def test_functions_of_another_shape_are_refused(shape):
    with pytest.raises(InputError, match=r"expected \(depths, 3, K, K\), K odd"):
        check_functions(torch.ones(shape))
    with pytest.raises(InputError, match=r"expected \(4, 3, K, K\)"):
        OpponentWiener(2, (1, 1, 1), depths=4)(torch.ones(1, 3, 8, 8), torch.ones(2, 3, 5, 5))


@pytest.mark.parametrize(
    "wrong", [{"noise_to_signal": (1.0, 2.0)}, {"noise_to_signal": (1.0, -2.0, 1.0)}]
)
def test_ratios_are_three_positive_numbers(wrong):
    with pytest.raises(InputError, match="three positive numbers"):
        OpponentWiener(2, **wrong)


@pytest.mark.parametrize(("margin", "depths"), [(-1, 0), (2, -1)])
def test_negative_numbers_are_refused(margin, depths):
    with pytest.raises(InputError, match="must be at least 0"):
        OpponentWiener(margin, (1.0, 1.0, 1.0), depths)


def test_functions_that_lose_nearly_all_light_have_finite_gradients_in_single_precision():
    functions = 1e-5 * torch.rand(2, 3, 9, 9, generator=torch.Generator().manual_seed(0))
    functions.requires_grad_(True)
    ratios = torch.tensor([1.0, 7.0, 20.0], requires_grad=True)
    image = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    restored = opponent_wiener_deconvolve(image, functions, ratios, 4)
    gradients = torch.autograd.grad(restored.square().mean(), (functions, ratios))
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)
