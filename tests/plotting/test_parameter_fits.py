"""Convergence of a fit, and the covariance of what it found."""

import math

import numpy as np
import pytest
import torch
from matplotlib.patches import Ellipse

from dolens.errors import InputError
from dolens.plotting.parameter_fits import convergence_figure, corner_figure
from tests.plotting.overlaps import flaws

COVARIANCE = torch.tensor([[4.0, 1.0, -0.5], [1.0, 1.0, 0.2], [-0.5, 0.2, 9.0]])
LABELS, UNITS = ["a", "b", "c"], ["mm", "mm", "deg"]


def ellipses(axes):
    return [patch for patch in axes.patches if isinstance(patch, Ellipse)]


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


def test_a_fit_of_many_variables():
    count = 30
    values = {f"source {n} z": ([1.0 / (k + n + 1) for k in range(count)], "mm") for n in range(9)}
    values["tilt"] = ([2.0 / (k + 1) for k in range(count)], "deg")
    losses = {"loss S21 (no unit)": [1.0 / (k + 1) for k in range(count)]}
    truth = dict.fromkeys(values, 0.0)
    figure = convergence_figure(losses, values, [("adam", 20), ("dls", 10)], truth, "Title")
    assert not flaws(figure)
    # Errors in mm, after the loss.
    lines = [line for line in figure.axes[1].get_lines() if line.get_label().startswith("source")]
    looks = {
        (line.get_color(), str(line.get_linestyle()), line._unscaled_dash_pattern) for line in lines
    }
    assert len(looks) == 9


def test_values_have_the_digits_that_their_deviations_allow():
    covariance = torch.diag(torch.tensor([3.3**2, 5.5e-3**2, 0.16**2]))
    centre = torch.tensor([-666.725, 119.45, 0.0])
    figure = corner_figure(covariance, ["z", "distance", "x"], ["mm", "mm", "deg"], centre)
    grid = np.array(figure.axes).reshape(3, 3)
    texts = [grid[n, n].texts[0].get_text() for n in range(3)]
    assert texts == ["z\n−667\n± 3 mm", "distance\n119.450\n± 0.005 mm", "x\n0.00\n± 0.16°"]
    assert not [flaw for flaw in flaws(figure) if "unit" not in flaw]
