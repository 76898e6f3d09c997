"""Pictures restored by windows: no seams, and the functions and noise of each place."""

import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import (
    GeneralRestoration,
    Restoration,
    WienerTVRestoration,
    wiener_deconvolve,
)
from dolens.reconstruction.whole_pictures import (
    mirrored,
    restore_whole_picture,
    stretches,
)
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear
from dolens.sensor.readout import Readout

BRIGHT = Readout(full_well=1e6, read_noise=1e-6)


class Recorded(Restoration):
    """Shows what it is given, and keeps what it was told."""

    def __init__(self):
        super().__init__()
        self.told = []

    def forward(self, raw, point_spread_functions, field, noise):
        self.told.append((raw.shape, point_spread_functions, noise))
        return linear_to_srgb(raw)


class Wiener(Restoration):
    """One linear filter, whose strength does not follow the light."""

    def forward(self, raw, point_spread_functions, field, noise):
        functions = point_spread_functions[0]
        return linear_to_srgb(wiener_deconvolve(raw, functions, 0.02, functions.shape[-1] // 2))


def gaussians(rows, columns):
    """Functions whose width grows by a pixel over 200 columns."""
    offsets = torch.arange(15) - 7.0
    line = torch.exp(-0.5 * (offsets / (1.0 + columns[:, None] / 200.0)) ** 2)
    square = line[:, :, None] * line[:, None]
    square = square / square.sum((-2, -1), keepdim=True)
    return square[:, None, None].expand(-1, 1, 3, -1, -1)


def even(rows, columns):
    return torch.ones(3, len(rows), len(columns))


def falling(rows, columns):
    """Relative illumination that falls to a third across the picture."""
    return (1.0 - columns / 300.0).expand(3, len(rows), len(columns))


def blocks(height=90, width=200):
    coarse = torch.rand(1, 3, height // 6, width // 6)
    return 0.1 + 0.8 * torch.nn.functional.interpolate(coarse, (height, width))[0]


@pytest.mark.parametrize(("length", "window"), [(200, 64), (100, 512), (33, 32), (1000, 128)])
def test_what_windows_keep_adds_up_to_the_picture(length, window):
    total, before = torch.zeros(length), 0
    for part in stretches(length, window, 32):
        total[part.first : part.end] += part.weight
        assert part.first <= before and part.end - part.first <= window + 32
        before = part.end
    assert torch.allclose(total, torch.ones(length)) and before == length


def test_beyond_an_edge_the_mirror_image_goes_on():
    assert mirrored(-2, 6, 4).tolist() == [2, 1, 0, 1, 2, 3, 2, 1]
    assert mirrored(-1, 2, 1).tolist() == [0, 0, 0]


@pytest.mark.parametrize("window", [32, 64, 256])
def test_nothing_of_the_windows_shows_where_nothing_is_done(window):
    picture = blocks()
    found = restore_whole_picture(Recorded(), picture, BRIGHT, gaussians, even, window)
    assert (found - linear_to_srgb(picture)).abs().max() < 1e-5


def blurred(picture):
    """The picture with each column blurred by the functions there."""
    width = picture.shape[-1]
    padded = torch.nn.functional.pad(picture[None], (7,) * 4, mode="replicate")[0]
    patches = padded.unfold(1, 15, 1).unfold(2, 15, 1)  # (3, H, W, 15, 15)
    functions = gaussians(torch.zeros(width), torch.arange(float(width)))[:, 0]
    return torch.einsum("chwij,wcij->chw", patches, functions.flip(-2, -1))


def test_two_sizes_of_windows_restore_the_same_picture():
    """Functions change by a third of a pixel in width over the larger ones."""
    picture = blocks()
    image = blurred(picture)
    small, large = (
        restore_whole_picture(Wiener(), image, BRIGHT, gaussians, even, window)
        for window in (32, 64)
    )
    truth = linear_to_srgb(picture)
    left_over = (small - truth).square().mean().sqrt()
    assert (small - large).square().mean().sqrt() < 0.15 * left_over
    # One function for all of it makes another picture.
    whole = restore_whole_picture(Wiener(), image, BRIGHT, gaussians, even, 256)
    differences = [(small - other)[..., 150:].square().mean().sqrt() for other in (large, whole)]
    assert differences[1] > 3.0 * differences[0]


@pytest.mark.parametrize("pattern", [None, "RGGB"])
def test_a_flat_picture_stays_flat(pattern):
    """Light that falls off, blur that changes, and filters of three colours leave no trace."""
    colour = torch.tensor([0.5, 0.3, 0.15])[:, None, None]
    readout = Readout(full_well=1e8, read_noise=1e-7, pattern=pattern)
    image = colour * falling(torch.arange(90), torch.arange(200.0))
    signal = readout(image, torch.Generator().manual_seed(0))
    assert signal.shape[0] == (3 if pattern is None else 1)
    found = restore_whole_picture(WienerTVRestoration(), signal, readout, gaussians, falling, 48)
    # Where light falls, interpolated colours are those of a ramp, exact but at the edges.
    inner = found[:, 4:-4, 4:-4]
    assert (inner - linear_to_srgb(colour)).abs().max() < 0.01
    assert (srgb_to_linear(found) - colour).abs().mean() < 0.002


def test_windows_of_a_mosaic_begin_with_its_first_filter():
    """An odd place of a window would take red for green."""
    colour = torch.tensor([0.9, 0.4, 0.1])[:, None, None].expand(3, 90, 200)
    readout = Readout(pattern="GBRG")
    signal = readout(colour, torch.Generator())
    for window in (33, 47, 64):
        found = restore_whole_picture(Recorded(), signal, readout, gaussians, even, window)
        assert (found - linear_to_srgb(colour)).abs().max() < 1e-4


def test_a_restorer_is_told_the_functions_and_the_noise_of_its_place():
    """Where a third of the light is left, shot noise is three times that of the axis and read
    noise nine times, in variance.
    """
    restorer = Recorded()
    readout = Readout(full_well=100.0, read_noise=0.03)
    rows = torch.tensor([44.5])
    several = lambda r, c: gaussians(r, c).expand(-1, 3, -1, -1, -1)  # noqa: E731
    restore_whole_picture(restorer, blocks(), readout, several, falling, 96, overlap=0)
    _, functions, noise = restorer.told[-1]
    light = float(falling(rows, torch.tensor([166.5]))[0, 0, 0])
    assert functions.shape == (3, 3, 15, 15)
    assert noise[0] == pytest.approx(0.01 / light, rel=0.1)
    assert noise[1] == pytest.approx(0.0009 / light**2, rel=0.2)
    middle = gaussians(rows, torch.tensor([166.0]))[0, 0, 0]
    assert (functions[0, 0] - middle).abs().max() < 0.01 * middle.max()
    assert len(restorer.told) == 3


def test_what_is_seen_at_once_does_not_grow_with_the_picture():
    restorer = Recorded()
    for width in (200, 800):
        restore_whole_picture(restorer, torch.rand(3, 90, width), BRIGHT, gaussians, even, 64)
    sides = {max(shape[-2:]) for shape, _, _ in restorer.told}
    assert max(sides) <= 64 + 32 + 2 * (16 + 7) + 1


def test_a_window_that_is_too_small_is_refused():
    with pytest.raises(InputError, match="window: 16; allowed: 32 or more"):
        restore_whole_picture(
            GeneralRestoration(by_depth=True).eval(), blocks(), BRIGHT, gaussians, even, 16
        )


def test_the_general_restorer_takes_what_windows_tell():
    restorer = GeneralRestoration(by_depth=True).eval()
    assert restorer.needs_noise and restorer.needs_point_spread_function
