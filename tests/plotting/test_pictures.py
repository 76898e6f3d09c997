import numpy as np
import pytest
import torch

from dolens.errors import InputError
from dolens.plotting import comparison_figure, psf_figure


def spots(size=41):
    """Unit sums; 1, 3×3 and 9×9 equal pixels, in one channel each of three depths."""
    psfs = torch.zeros(3, 3, size, size, dtype=torch.float64)
    middle = size // 2
    for depth, reach in enumerate((0, 1, 4)):
        box = slice(middle - reach, middle + reach + 1)
        psfs[depth, depth, box, box] = 1.0 / (2 * reach + 1) ** 2
    return psfs


def pictures(figure):
    return [np.asarray(axes.images[0].get_array()) for axes in figure.axes]


def texts(axes):
    return [text.get_text() for text in axes.texts]


def test_psfs_are_cropped_alike_to_the_window_of_the_widest():
    figure = psf_figure(spots(), ["1m", "2m", "8m"], 0.00345, "spots")
    assert [axes.get_title().partition("\n")[0] for axes in figure.axes] == ["1m", "2m", "8m"]
    assert [picture.shape for picture in pictures(figure)] == [(11, 11, 3)] * 3
    assert all(axes.images[0].get_interpolation() == "nearest" for axes in figure.axes)


def test_a_faint_halo_beyond_a_fifth_of_a_percent_widens_the_window():
    def window(halo):
        psfs = spots()
        psfs[0] *= 1.0 - halo
        psfs[0, 0, 0, 0] = halo
        return pictures(psf_figure(psfs, "abc", 0.01))[0].shape[0]

    # To the corner where the halo is, and a pixel about it on the other sides.
    assert (window(0.0015), window(0.0025)) == (11, 27)


def test_each_psf_is_normalised_to_its_own_printed_peak():
    figure = psf_figure(spots(), "abc", 0.00345)
    for depth, picture in enumerate(pictures(figure)):
        assert picture.max() == pytest.approx(1.0)
        assert picture[5, 5].tolist() == pytest.approx([float(c == depth) for c in range(3)])
    peaks = [axes.get_title().partition("\n")[2] for axes in figure.axes]
    assert peaks == ["peak 1", "peak 0.11", "peak 0.012"]


def test_psfs_are_encoded_for_display():
    psfs = spots()
    psfs[2, :, 20, 20] *= 2.0
    picture = pictures(psf_figure(psfs, "abc", 0.01))[2]
    assert picture[5, 6, 2] == pytest.approx(0.735357, abs=1e-5)  # sRGB of one half


def test_the_scale_bar_is_as_long_as_it_says():
    axes = psf_figure(spots(), "abc", 0.00345).axes[0]
    (bar,) = axes.get_lines()
    assert 11.0 * 3.45 * np.ptp(bar.get_xdata()) == pytest.approx(10.0)
    assert texts(axes) == ["10 µm"]


def test_a_dark_psf_is_black_and_many_depths_wrap():
    figure = psf_figure(torch.zeros(8, 3, 9, 9), "abcdefgh", 0.01)
    assert len(figure.axes) == 8
    assert all(picture.max() == 0.0 for picture in pictures(figure))
    rows = {axes.get_subplotspec().rowspan.start for axes in figure.axes}
    assert rows == {0, 1}


@pytest.mark.parametrize("shape", [(3, 9, 9), (2, 1, 9, 9), (2, 3, 9, 8), (3, 3, 9, 9)])
def test_psfs_of_another_shape_are_refused(shape):
    with pytest.raises(InputError):
        psf_figure(torch.ones(shape), ["a", "b"], 0.01)


def images(depths=2, height=12, width=16):
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(3, height, width, generator=generator)
    stack = torch.rand(2, depths, 3, height, width, generator=generator)
    return truth, stack[0], stack[1]


def test_comparison_shows_each_image_in_its_place():
    truth, raw, restored = images()
    psnr = {"raw": [21.04, 22.0], "restored": [30.06, 31.0]}
    figure = comparison_figure(truth, raw, restored, ["1m", "8m"], psnr)
    shown = {axes.get_title(): axes.images[0] for axes in figure.axes}
    expected = {
        "truth": truth,
        "1m\nraw: 21.0 dB": raw[0],
        "8m\nraw: 22.0 dB": raw[1],
        "restored: 30.1 dB": restored[0],
        "restored: 31.0 dB": restored[1],
    }
    assert shown.keys() == expected.keys()
    for title, image in expected.items():
        np.testing.assert_array_equal(shown[title].get_array(), image.permute(1, 2, 0).numpy())
        assert shown[title].get_interpolation() == "nearest"
    places = {axes.get_title(): axes.get_subplotspec().get_geometry()[2:] for axes in figure.axes}
    # Cells of two rows of three, by first and last number.
    assert places["truth"] == (0, 3)
    # Labels stand above their columns.
    below = places["8m\nraw: 22.0 dB"], places["restored: 31.0 dB"]
    assert below == ((2, 2), (5, 5)) and places["restored: 30.1 dB"] == (4, 4)


def test_comparison_without_numbers_names_the_images_only():
    figure = comparison_figure(*images(depths=1), ["1m"])
    assert [axes.get_title() for axes in figure.axes] == ["truth", "1m\nraw", "restored"]


def test_values_beyond_the_display_are_clipped():
    truth, raw, restored = images()
    figure = comparison_figure(truth, raw + 2.0, restored - 2.0, "ab")
    assert {float(picture.mean()) for picture in pictures(figure)[1:]} == {0.0, 1.0}


def test_comparison_refuses_what_does_not_match():
    truth, raw, restored = images()
    with pytest.raises(InputError, match="expected truth"):
        comparison_figure(truth, raw, restored[:1], "ab")
    with pytest.raises(InputError, match="expected truth"):
        comparison_figure(truth[:, 1:], raw, restored, "ab")
    with pytest.raises(InputError, match="labels"):
        comparison_figure(truth, raw, restored, "abc")
