"""One network for any lens: what it is told is true, and it starts from Wiener's filter."""

import pickle

import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import GeneralRestoration, WienerTVRestoration, psnr_db
from dolens.reconstruction.general import COLORS, KNOWN, Stabiliser, prepared
from dolens.reconstruction.opponent_wiener import opponent_wiener_deconvolve
from dolens.reconstruction.untrained import REFERENCE_VARIANCE
from dolens.sensor.colour import linear_to_srgb
from tests.reconstruction.test_untrained import NOISE, disc, sensed

SHARP = torch.zeros(1, 3, 5, 5)
SHARP[..., 2, 2] = 1.0


def untrained(**options):
    return GeneralRestoration(weights="none", **options)


def steps(size=96):
    """Linear light with edges along both axes, (3, size, size)."""
    x = torch.arange(size)
    board = ((x[:, None] // 24 + x // 32) % 2).float()
    return torch.stack([0.2 + 0.5 * board, 0.3 + 0.3 * board, 0.6 - 0.4 * board])


def test_noise_has_the_same_strength_at_any_light():
    shot, read = NOISE.double()
    stabiliser = Stabiliser((read / shot + 0.375 * shot)[None])
    light = torch.tensor([0.05, 0.2, 0.8], dtype=torch.float64)[:, None]
    normal = torch.randn(3, 200_000, generator=torch.Generator().manual_seed(2)).double()
    noisy = light + (shot * light + read).sqrt() * normal
    found = stabiliser.forward(noisy[None]).std(dim=-1)[0]
    assert float(found.max() / found.min()) < 1.06
    assert float(noisy.std(dim=-1).max() / noisy.std(dim=-1).min()) > 2.0


@pytest.mark.parametrize("pedestal", [1e-5, 0.1, 1e4])
def test_black_and_white_stay_and_light_comes_back(pedestal):
    stabiliser = Stabiliser(torch.tensor([pedestal], dtype=torch.float64))
    light = torch.linspace(0.0, 1.0, 33).double()[None]
    values = stabiliser.forward(light)
    assert torch.allclose(values[:, [0, -1]], torch.tensor([[0.0, 1.0]]).double(), atol=1e-11)
    assert torch.allclose(stabiliser.inverse(values), light, atol=1e-9)


def test_the_network_sees_the_sensor_image_and_three_filters():
    raw = sensed(steps(), disc())[None]
    given = prepared(raw, disc(), NOISE)
    images = Stabiliser(given.pedestal).inverse(given.images.unflatten(1, (4, COLORS)))
    inside = raw[0] > 0.0
    assert torch.allclose(images[0, 0][inside], raw[0][inside], atol=1e-5)
    factor = float((0.2 * NOISE[0] + NOISE[1]) / REFERENCE_VARIANCE)
    for number, ratio in enumerate((0.1, 0.4, 1.6), start=1):
        ratios = factor * ratio * torch.tensor([1.0, 7.0, 20.0])
        expected = opponent_wiener_deconvolve(raw, disc(), ratios, 4)[0]
        inside = expected > 0.0
        assert torch.allclose(images[0, number][inside], expected[inside], atol=1e-4)


def test_what_is_known_does_not_depend_on_the_size_of_the_image():
    small, large = (prepared(torch.rand(1, 3, n, n), disc(), NOISE).known for n in (32, 80))
    assert small.shape == (1, KNOWN)
    assert torch.equal(small, large)


def test_more_light_and_a_sharper_lens_are_known():
    raw = torch.rand(1, 3, 32, 32)
    known = [prepared(raw, f, n).known[0] for f, n in ((disc(), NOISE), (SHARP, 0.1 * NOISE))]
    assert known[1][0] < known[0][0]  # noise
    # Transfer of the middle filter in the band from 3/8 to 1/2 of Nyquist's frequency.
    assert known[1][3 + 6 + 3] > known[0][3 + 6 + 3]
    depths = torch.cat([disc(9, 1.0), disc(9, 3.5)])
    several = prepared(raw, depths, NOISE).known[0]
    assert several[2] == 1.0
    assert known[0][2] == 0.0
    spread = slice(3 + 18, 3 + 24)
    assert several[spread].max() > 0.05
    assert known[0][spread].abs().max() < 1e-6


def test_without_training_it_is_the_middle_filter():
    network = untrained()
    raw = sensed(steps(), disc())[None]
    given = prepared(raw, disc(), NOISE)
    middle = Stabiliser(given.pedestal).inverse(given.images[:, 6:9])
    restored = network(raw, disc(), None, NOISE).detach()
    assert torch.allclose(restored.clamp(0.0, 1.0), linear_to_srgb(middle), atol=1e-6)


def test_gradients_reach_the_lens_and_agree_with_differences():
    torch.manual_seed(0)
    network = untrained(width=8, down=(1,), middle=1, up=(1,)).double()
    torch.nn.init.normal_(network.network.output.weight, std=0.05)
    raw = sensed(steps(32), disc())[None].double()
    functions = disc().double().requires_grad_(True)
    direction = torch.randn(functions.shape, generator=torch.Generator().manual_seed(1)).double()

    def total(shift):
        return network(raw, functions + shift * direction, None, NOISE.double()).square().sum()

    total(0.0).backward()
    slope = float((functions.grad * direction).sum())
    with torch.no_grad():
        difference = float(total(1e-5) - total(-1e-5)) / 2e-5
    assert slope == pytest.approx(difference, rel=1e-4)


def test_a_network_trained_for_any_lens_is_ahead_of_total_variation():
    functions = disc()
    truth = steps(128)
    raw = sensed(truth, functions)[None]
    scores = [
        float(
            psnr_db(network(raw, functions, None, NOISE).clamp(0, 1), linear_to_srgb(truth)[None])
        )
        for network in (GeneralRestoration().eval(), WienerTVRestoration())
    ]
    assert scores[0] > scores[1]


def test_a_flat_field_stays_flat_at_any_light():
    network = GeneralRestoration().eval()
    truth = torch.tensor([0.2, 0.35, 0.3])[:, None, None].expand(3, 128, 128)
    for light in (30.0, 100.0, 1000.0):
        noise = torch.tensor([1.0 / light, (3.0 / light) ** 2])
        generator = torch.Generator().manual_seed(3)
        deviation = (noise[0] * truth + noise[1]).sqrt()
        raw = truth + deviation * torch.randn(truth.shape, generator=generator)
        with torch.no_grad():
            restored = network(raw[None], SHARP, None, noise)[0]
        error = restored - linear_to_srgb(truth)
        assert float(error.mean().abs()) < 0.005
        noisy = (linear_to_srgb(raw) - linear_to_srgb(truth)).std()
        assert float(error.std()) < 0.3 * float(noisy)


def test_weights_come_back_from_a_file(tmp_path):
    network = untrained(width=8)
    torch.nn.init.normal_(network.network.output.weight)
    network.save_weights(tmp_path / "weights.pt")
    again = GeneralRestoration(weights=str(tmp_path / "weights.pt"), width=8)
    assert again.pretrained
    assert not untrained(width=8).pretrained
    for name, value in network.state_dict().items():
        assert torch.allclose(again.state_dict()[name], value, rtol=1e-3, atol=1e-6)


class Stranger:
    """Executes what it likes when it is unpickled."""

    def __reduce__(self):
        return (print, ("executed",))


@pytest.mark.parametrize("content", ["missing", "text", "pickle", "widths"])
def test_a_file_that_holds_no_weights_is_refused_in_one_line(tmp_path, capsys, content):
    file = tmp_path / "weights.pt"
    if content == "text":
        file.write_text("weights")
    if content == "pickle":
        file.write_bytes(pickle.dumps(Stranger()))
    if content == "widths":
        untrained(width=8).save_weights(file)
    with pytest.raises(InputError, match=r"network\.weights: .*weights\.pt") as problem:
        GeneralRestoration(weights=str(file))
    assert "\n" not in str(problem.value)
    assert "executed" not in capsys.readouterr().out


def test_it_needs_the_lens_and_the_noise():
    with pytest.raises(InputError, match="point spread functions and the sensor's noise"):
        untrained(width=8)(torch.zeros(1, 3, 16, 16), SHARP)


def test_weights_that_nothing_trained_are_not_held():
    with pytest.raises(InputError, match=r"network\.held: true; allowed with"):
        untrained(held=True)


@pytest.mark.parametrize("restorer", [GeneralRestoration(by_depth=True), WienerTVRestoration()])
@pytest.mark.parametrize("depths", [1, 2])
def test_an_image_with_functions_of_its_own_is_restored_as_by_itself(restorer, depths):
    functions = torch.stack(
        [torch.cat([disc(9, w), disc(9, w + 2.0)])[:depths] for w in (1.0, 3.0)]
    )
    raw = torch.stack([sensed(steps(), own[:1]) for own in functions])
    with torch.no_grad():
        together = restorer(raw, functions, None, NOISE)
        alone = [restorer(r[None], f, None, NOISE) for r, f in zip(raw, functions, strict=True)]
    assert torch.allclose(together, torch.cat(alone), atol=1e-5)
    assert (together[0] - together[1]).abs().max() > 0.1
    with pytest.raises(InputError, match=r"\(depths, 3, K, K\), or \(2, depths, 3, K, K\)"):
        restorer(raw, functions[:1], None, NOISE)
