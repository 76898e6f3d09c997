"""Figures of several runs show every mean, the seeds and the ends of intervals, with units."""

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dolens.plotting import RunPoint, runs_curve, runs_figure
from dolens.plotting.runs import Curve, quality_figure
from tests.plotting.artists import legend

SEEDS = RunPoint(25.0, (24.5, 25.5))
SINGLE = RunPoint(26.0, (26.0,), 25.0, 27.5)


def ends(axes):
    """The ends of each error bar."""
    return [tuple(map(tuple, s)) for c in axes.collections for s in c.get_segments()]


def test_rows_stand_from_above_with_their_bars_and_seeds():
    figure = runs_figure(["a", "b"], [SEEDS, SINGLE], "test PSNR (dB)", "two runs")
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]
    assert axes.yaxis_inverted()
    assert ((24.5, 0.0), (25.5, 0.0)) in ends(axes)
    assert ((25.0, 1.0), (27.5, 1.0)) in ends(axes)
    assert axes.get_xlabel() == "test PSNR (dB)"
    assert "95 % interval over photographs" in axes.get_title()
    dots = [line for line in axes.lines if list(line.get_xdata()) == [24.5, 25.5]]
    assert any(line.get_marker() == "o" for line in dots)


def test_a_curve_is_drawn_in_the_order_of_the_setting():
    line = [(21.0, SINGLE), (20.0, SEEDS)]
    (axes,) = runs_curve({"": line}, "radius (mm)", "PSNR (dB)").axes
    assert [25.0, 26.0] in [list(drawn.get_ydata()) for drawn in axes.lines]
    assert axes.get_xscale() == "linear" and axes.get_xlabel() == "radius (mm)"


@pytest.mark.parametrize(("values", "scale"), [((1.0, 100.0), "log"), ((-1.0, 100.0), "linear")])
def test_a_setting_over_decades_is_drawn_logarithmically(values, scale):
    (axes,) = runs_curve({"": [(v, SEEDS) for v in values]}, "x", "y").axes
    assert axes.get_xscale() == scale


def test_several_lines_have_a_legend():
    figure = runs_curve({"unet": [(1.0, SEEDS)], "wiener": [(1.0, SINGLE)]}, "x", "y")
    assert legend(figure) == ["unet", "wiener"]


def test_long_labels_are_broken_and_stay_within_the_figure():
    label = ", ".join(f"setting_{n}={n}" for n in range(20))
    figure = runs_figure([label], [SINGLE], "y")
    FigureCanvasAgg(figure).draw()
    (text,) = figure.axes[0].get_yticklabels()
    assert text.get_text().endswith("…") and "\n" in text.get_text()
    assert text.get_window_extent().x0 >= 0.0


def test_every_network_has_a_line_with_its_intervals():
    found = [
        Curve("one", [20.0, 70.0], [22.0, 23.0], [21.0, 22.5], [23.0, 23.5]),
        Curve("other", [20.0], [24.0], [23.0], [25.0]),
    ]
    figure = quality_figure(found)
    (axes,) = figure.axes
    assert len(axes.containers) == 2
    assert legend(figure) == ["one", "other"]
    low, high = axes.get_ylim()
    assert low < 21.0 and high > 25.0
