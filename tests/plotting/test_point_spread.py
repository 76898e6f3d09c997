"""Point spread functions and encircled energy, in micrometres."""

import math

import numpy as np
import pytest
import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.encircled_energy import encircled_energy
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import diffraction_encircled_energy, point_spread
from dolens.errors import InputError
from dolens.plotting import (
    psf_figure,
)
from dolens.plotting.modulation import modulation_comparison_figure
from dolens.plotting.point_spread import (
    encircled_energy_figure,
    point_spread_figure,
    window_of_light,
)
from tests.plotting.artists import by_gid, legend
from tests.plotting.overlaps import flaws

LINES = (656.2725, 587.5618, 486.1327)
DARK = [(0.0, 0.0), (0.0, 45.0)]


def test_fields_without_light_are_named_so(triplet):
    frequency = [0.0, 20.0, 40.0]
    where = conditions(triplet, DARK, LINES[1:2])
    mtf = diffraction_modulation(triplet, where, frequency)
    assert "45° (no light passes)" in legend(modulation_comparison_figure(mtf))
    waves = diffraction_encircled_energy(triplet, where, [5.0, 10.0])
    rays = encircled_energy(triplet, where, [5.0, 10.0], rays=40)
    figure = encircled_energy_figure(waves, rays)
    assert "45° (no light passes)" in legend(figure)
    drawn = [np.asarray(line.get_ydata()) for line in by_gid(figure.axes[0], "energy")]
    assert sum(bool(np.isfinite(line).all()) for line in drawn) == 2
    psf = point_spread(triplet, where, cells=32)
    titles = [axes.get_title() for axes in point_spread_figure(psf).axes]
    assert titles[0].startswith("0°\nStrehl ratio 0.2")
    assert titles[1] == "45°\nno light passes"


def test_point_spread_functions_have_axes_in_micrometres(triplet):
    psf = point_spread(triplet, conditions(triplet, [(0.0, 14.0)], LINES[1:2]), cells=32)
    figure = point_spread_figure(psf, None)
    axes = figure.axes[0]
    (picture,) = axes.images
    half = float(psf.half_width_um[0])
    assert picture.get_extent() == [-half, half, -half, half]
    assert float(np.max(picture.get_array())) == 1.0 and picture.origin == "lower"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (µm)", "y (µm)")


def test_nothing_to_plot_is_refused():
    with pytest.raises(InputError, match="MTF"):
        modulation_comparison_figure()
    assert math.isfinite(encircled_energy_figure().get_figheight())


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


def test_a_window_holds_nearly_all_light_of_every_function():
    """A cubic plate's triangles lie in one quadrant, and their windows about them."""
    psfs = torch.zeros(2, 3, 65, 65, dtype=torch.float64)
    psfs[0, :, 32:60, 32:60] = torch.ones(28, 28).triu().double()
    psfs[1, :, 30:50, 31:52] = 1.0
    top, left, side = window_of_light(psfs.sum(1))
    held = psfs[..., top : top + side, left : left + side].sum((1, 2, 3)) / psfs.sum((1, 2, 3))
    assert (held >= 0.99).all() and side <= 32
    figure = psf_figure(psfs, ["8 m", "4.5 m"], 0.0069, "Triangles")
    assert not flaws(figure)
    drawn = [axes.images[0].get_array() for axes in figure.axes]
    assert {picture.shape for picture in drawn} == {(side, side, 3)}
