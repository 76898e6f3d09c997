import math

import numpy as np
import pytest
import torch
from matplotlib.patches import Ellipse

from dolens.errors import InputError
from dolens.experiments.poses.pose_figures import image_labels
from dolens.plotting.parameter_fits import convergence_figure, corner_figure
from dolens.plotting.pictures import spot_fit_figure

COVARIANCE = torch.tensor([[4.0, 1.0, -0.5], [1.0, 1.0, 0.2], [-0.5, 0.2, 9.0]])
LABELS, UNITS = ["a", "b", "c"], ["mm", "mm", "deg"]


def ellipses(axes):
    return [patch for patch in axes.patches if isinstance(patch, Ellipse)]


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


def test_stages_part_where_the_optimizer_changes_and_errors_are_against_the_truth():
    loss = [1.0, 0.5, 0.2, 0.1, 0.05]
    values = {
        "tilt": ([1.0, 1.5, 2.2, 1.9, 2.0], "deg"),
        "shift": ([0.0, 0.1, 0.2, 0.3, 0.4], "mm"),
        "z": ([5.0, 5.0, 5.0, 5.0, 5.0], "mm"),
    }
    stages = [("adam", 2), ("dls", 1), ("adam", 2)]
    figure = convergence_figure(loss, values, stages, {"tilt": 2.0, "shift": 0.4})
    top, tilt, shift, z = figure.axes
    for axes in figure.axes:
        borders = [line.get_xdata()[0] for line in axes.get_lines()[1:]]
        assert borders == [2.5, 3.5]
        assert list(axes.get_lines()[0].get_xdata()) == [1, 2, 3, 4, 5]
    assert [(t.get_text(), t.get_position()[0]) for t in top.texts] == [
        ("adam", 1.5),
        ("dls", 3.0),
        ("adam", 4.5),
    ]
    assert list(tilt.get_lines()[0].get_ydata()) == pytest.approx([1.0, 0.5, 0.2, 0.1, 0.0])
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "log", "log", "linear"]
    assert [shift.get_ylabel(), z.get_ylabel()] == ["|error| (mm)", "value (mm)"]
    assert list(z.get_lines()[0].get_ydata()) == values["z"][0]
    figure.draw_without_rendering()
    with pytest.raises(InputError, match="loss: 5 values for 4 iterations"):
        convergence_figure(loss, values, [*stages[:2], ("adam", 1)])


def test_ellipses_lie_along_the_eigenvectors_of_the_covariance():
    figure = corner_figure(COVARIANCE, LABELS, UNITS)
    grid = np.array(figure.axes).reshape(3, 3)
    for row in range(3):
        for column in range(3):
            assert len(ellipses(grid[row, column])) == (2 if row > column else 0)
    for row, column in ((1, 0), (2, 0), (2, 1)):
        pair = [column, row]
        values, vectors = np.linalg.eigh(COVARIANCE.double().numpy()[np.ix_(pair, pair)])
        for sigmas, found in zip((1.0, 2.0), ellipses(grid[row, column]), strict=True):
            assert found.get_center() == pytest.approx((0.0, 0.0))
            assert found.width == pytest.approx(2.0 * sigmas * math.sqrt(values[1]))
            assert found.height == pytest.approx(2.0 * sigmas * math.sqrt(values[0]))
            angle = math.radians(found.angle)
            along = np.array([math.cos(angle), math.sin(angle)])
            assert abs(along @ vectors[:, 1]) == pytest.approx(1.0)
    assert grid[0, 1].texts[0].get_text() == "+0.50"
    assert grid[0, 2].texts[0].get_text() == "−0.08"
    assert grid[2, 2].texts[0].get_text() == "c\nσ = 3°"
    figure.draw_without_rendering()


def test_points_and_truth_count_from_the_centre_and_small_units_become_thousandths():
    scale = torch.tensor([1e-3, 1.0, 1e-2])
    covariance = COVARIANCE * torch.outer(scale, scale)
    centre = torch.tensor([2.0, -1.0, 30.0])
    points = centre + scale * torch.tensor([[1.0, 0.5, -2.0], [-1.0, 0.0, 3.0]])
    truth = centre + scale * torch.tensor([-1.5, 0.5, 100.0])
    figure = corner_figure(covariance, LABELS, UNITS, centre.double(), points, truth, "Title")
    grid = np.array(figure.axes).reshape(3, 3)
    dots, cross = grid[1, 0].get_lines()
    assert dots.get_xdata() == pytest.approx([1.0, -1.0], abs=1e-3)
    assert dots.get_ydata() == pytest.approx([0.5, 0.0], abs=1e-3)
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == pytest.approx((-1.5, 0.5), abs=1e-3)
    assert ellipses(grid[1, 0])[0].width == pytest.approx(
        ellipses(corner_figure(COVARIANCE, LABELS, UNITS).axes[3])[0].width, rel=1e-5
    )
    assert grid[0, 0].texts[0].get_text() == "a\n2.000\n± 0.002 mm"
    assert grid[2, 2].texts[0].get_text() == "c\n30.00\n± 0.03°"
    # That of c is far beyond the ellipses.
    assert len(grid[2, 0].get_lines()) == 1
    assert figure.get_suptitle() == "Title\ntruth more than 6σ off, not drawn: c"
    figure.draw_without_rendering()


def test_a_covariance_of_another_shape_or_without_spread_is_refused():
    with pytest.raises(InputError, match="covariance does not fit 2 labels"):
        corner_figure(COVARIANCE, LABELS[:2], UNITS[:2])
    with pytest.raises(InputError, match="points does not fit"):
        corner_figure(COVARIANCE, LABELS, UNITS, points=torch.zeros(5, 2))
    with pytest.raises(InputError, match="variances must be positive"):
        corner_figure(0.0 * COVARIANCE, LABELS, UNITS)


def test_images_on_several_planes_name_their_plane():
    """One source on three planes, once labelled as three sources; a source's images together."""
    assert image_labels(1, [0.0]) == [""]
    assert image_labels(1, [0.0, -8.0]) == ["\nplane 0 mm", "\nplane −8 mm"]
    assert image_labels(2, [0.0]) == [", source 1", ", source 2"]
    both = image_labels(2, [0.0, 4.5])
    assert both[1:3] == [", source 1\nplane 4.5 mm", ", source 2\nplane 0 mm"]
