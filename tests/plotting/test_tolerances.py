"""Tolerances: matrices, yields and worst offenders."""

import math

import pytest
import torch

from dolens.errors import InputError
from dolens.plotting.tolerances import (
    matrix_figure,
    offenders_figure,
    parameter_label,
    tolerance_label,
    yield_figure,
)
from tests.plotting.overlaps import flaws


def test_a_matrix_keeps_its_numbers_rows_and_columns():
    left = torch.tensor([[1.0, -4.0], [0.0, 2.0], [3.0, 0.5]])
    panels = {"µm": (left, ["a", "b"]), "nm": (torch.zeros(3, 1), ["c"])}
    figure = matrix_figure(panels, ["p", "q", "r"], [("x", 1), ("y", 2)], "Title")
    first, second = (axes for axes in figure.axes if axes.images)
    assert (first.images[0].get_array() == left.numpy()).all()
    # White is zero, whatever the numbers.
    assert first.images[0].get_clim() == (-4.0, 4.0)
    assert second.images[0].get_clim() == (-1.0, 1.0)
    assert [t.get_text() for t in first.get_yticklabels()] == ["p", "q", "r"]
    assert [t.get_text() for t in first.get_xticklabels()] == ["a", "b"]
    bars = [axes for axes in figure.axes if not axes.images]
    assert [axes.get_xlabel() for axes in bars] == ["µm", "nm"]
    figure.draw_without_rendering()


def test_a_matrix_of_another_shape_is_refused():
    with pytest.raises(InputError, match=r"panel 'µm': 1 rows and 2 columns"):
        matrix_figure({"µm": (torch.zeros(2, 2), ["a", "b"])}, ["p"])


def test_yield_rises_to_the_share_of_lenses_that_do_not_fail():
    radii = torch.tensor([0.001, 0.002, 0.004, math.inf])
    figure = yield_figure({"RMS": {"traced": radii, "linear": radii}}, {"RMS": 0.001})
    line = figure.axes[0].get_lines()[0]
    assert list(line.get_ydata()) == [25.0, 50.0, 75.0, 100.0]
    assert list(line.get_xdata())[:3] == pytest.approx([1.0, 2.0, 4.0])
    low, high = figure.axes[0].get_xlim()
    assert low < 1.0 and high == pytest.approx(4.0)
    figure.draw_without_rendering()


def test_bars_are_in_per_cent_and_micrometres_the_worst_on_top():
    figure = offenders_figure(["tilt", "shift"], [0.7, 0.3], {"refocused": [1e-3, 2e-3]})
    left, right = figure.axes
    assert [bar.get_width() for bar in left.patches] == pytest.approx([70.0, 30.0])
    assert [bar.get_width() for bar in right.patches] == pytest.approx([1.0, 2.0])
    bottom, top = left.get_ylim()
    assert top < bottom
    figure.draw_without_rendering()


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("elements.front.tilt_x", "front tilt x"),
        ("surfaces.3.curvature", "curvature 3"),
        ("thicknesses.1", "thickness 1"),
        ("sensor_distance", "sensor distance"),
        ("sources.1.z", "source 1 z"),
        ("sources.*.x", "sources x"),
    ],
)
def test_parameters_in_words(name, label):
    assert parameter_label(name) == label


def test_tolerances_are_printed_with_their_units():
    assert tolerance_label("elements.front.tilt_x", "± 0.05°") == "front tilt x, ±0.05°"
    assert tolerance_label("surfaces.3.curvature", "± 0.1 %") == "curvature 3, ±0.1 %"
    assert tolerance_label("surfaces.3.curvature", "± 1e-05 1/mm") == "curvature 3, ±10⁻⁵ 1/mm"


def test_tolerances():
    rows, names = (
        [f"(0, {n})°  588 nm" for n in range(6)],
        [f"tilt {n}  ± 0.05°" for n in range(9)],
    )
    matrix = torch.randn(6, 9)
    figure = matrix_figure({"motion (µm)": (matrix, names)}, rows, [("x", 3), ("y", 3)], "Title")
    assert not flaws(figure)
    radii = torch.linspace(0.01, 0.02, 100)
    panels = {"RMS radius": {"Monte Carlo": radii, "linear": radii * 1.01}}
    assert not flaws(yield_figure(panels, {"RMS radius": 0.011}, "Title"))
    bars = offenders_figure(names, [0.1] * 9, {"refocused": [1e-3] * 9, "not": [2e-3] * 9}, "Title")
    assert not flaws(bars)
