"""Pictures of a camera and of sources, each in its place."""

import numpy as np
import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.poses.pose_figures import image_labels
from dolens.plotting import (
    comparison_figure,
)
from dolens.plotting.pictures import spot_fit_figure
from tests.plotting.overlaps import flaws


def pictures(figure):
    return [np.asarray(axes.images[0].get_array()) for axes in figure.axes]


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
    # Cells of two rows of three, by first and last number: the truth stands beside the raw images.
    assert places["truth"] == (0, 0)
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


def test_pictures_of_a_camera():
    image = torch.rand(3, 24, 24)
    views = image.expand(3, 3, 24, 24)
    psnr = {"raw": [20.0] * 3, "restored": [25.0] * 3}
    figure = comparison_figure(image, views, views, ["8 m", "6 m", "4.5 m"], psnr, "Title\nbelow")
    assert not flaws(figure)


def test_images_of_sources_are_not_clipped():
    measured, initial = torch.zeros(2, 1, 40, 40)
    measured[0, 10:30, 12:28], initial[0, 14:26, 14:26] = 1.0, 3.0
    figure = spot_fit_figure(measured, initial, measured, ["10°"], 0.05, "Title")
    assert not flaws(figure)
    panels = [axes.images[0] for axes in figure.axes if axes.images][:3]
    assert {panel.norm.gamma for panel in panels} == {1.0}
    brightest = max(float(panel.get_array().max()) for panel in panels)
    assert [panel.get_clim()[1] for panel in panels] == pytest.approx([brightest] * 3)


def test_light_around_a_focus_is_seen():
    """A disc of 1 % of the brightest pixel, a tenth up the colours by its root."""
    image = torch.zeros(1, 40, 40)
    image[0, 10:30, 10:30], image[0, 20, 20] = 0.01, 1.0
    figure = spot_fit_figure(image, image, image, ["0°"], 0.05, "Title")
    assert not flaws(figure)
    panel = next(axes.images[0] for axes in figure.axes if axes.images)
    assert float(panel.norm(0.01)) == pytest.approx(0.1)
    assert any("square-root scale" in axes.get_ylabel() for axes in figure.axes)


def spot(row, column, radius, size=60):
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    light = ((rows - row) ** 2 + (columns - column) ** 2 <= radius**2).double()
    return light / light.sum()


def test_rows_show_measured_initial_final_and_what_is_left_over():
    measured = torch.stack([spot(20, 30, 5), spot(40, 40, 8)])
    initial = torch.stack([spot(25, 32, 3), spot(38, 40, 6)])
    final = torch.stack([spot(20, 30, 5), spot(40, 41, 8)])
    figure = spot_fit_figure(measured, initial, final, ["near", "far"], 0.1, "Title")
    panels = [axes for axes in figure.axes if axes.images]
    bars = [axes for axes in figure.axes if not axes.images]
    assert (len(panels), len(bars)) == (8, 4)
    assert [panels[0].get_ylabel(), panels[4].get_ylabel()] == ["near", "far"]
    pictures = [axes.images[0].get_array() for axes in panels]
    # Cropped, but no light of any of the three is lost, nor moved.
    assert pictures[0].shape[0] < 25
    assert len({picture.shape for picture in pictures[:4]}) == 1
    for number, images in enumerate((measured, initial, final)):
        share = float(pictures[4 + number].sum() * measured[1].max())
        assert share == pytest.approx(1.0), images
    assert not pictures[3].any()
    assert np.allclose(pictures[7], 100.0 * (pictures[6] - pictures[4]))
    low, high = panels[7].images[0].get_clim()
    assert -low == high == pytest.approx(100.0)
    (bar,) = panels[0].get_lines()
    length = float(np.ptp(bar.get_xdata())) * pictures[0].shape[1] * 0.1
    assert panels[0].texts[-1].get_text().startswith(f"{length:g} mm")
    figure.draw_without_rendering()


def test_images_that_do_not_fit_or_have_no_light_are_refused():
    image = spot(20, 30, 5)[None]
    with pytest.raises(InputError, match="2 labels"):
        spot_fit_figure(image, image, image, ["a", "b"], 0.1)
    with pytest.raises(InputError, match="no light"):
        spot_fit_figure(0.0 * image, image, image, ["a"], 0.1)
    # A model whose light misses the sensor is worth a picture.
    spot_fit_figure(image, 0.0 * image, image, ["a"], 0.1).draw_without_rendering()


def test_images_on_several_planes_name_their_plane():
    """One source on three planes, once labelled as three sources; a source's images together."""
    assert image_labels(1, [0.0]) == [""]
    assert image_labels(1, [0.0, -8.0]) == ["\nplane 0 mm", "\nplane −8 mm"]
    assert image_labels(2, [0.0]) == [", source 1", ", source 2"]
    both = image_labels(2, [0.0, 4.5])
    assert both[1:3] == [", source 1\nplane 4.5 mm", ", source 2\nplane 0 mm"]
