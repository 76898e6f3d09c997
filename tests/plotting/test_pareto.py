"""Alternatives by cost and error, and where coding wins."""

import numpy as np
import pytest
from matplotlib.text import Text

from dolens.plotting import (
    Point,
    pareto_figure,
)
from dolens.plotting.pareto import GainRange, coding_gain_figure
from tests.plotting.overlaps import flaws


@pytest.mark.parametrize("spread", [1.0, 1.02])
def test_labels_of_alternatives_lie_apart(spread):
    """Eight alternatives of nearly one cost and error."""
    points = [Point(f"setting {n}", 1.0 + 0.01 * n, 2.0 - 0.01 * n * spread) for n in range(6)]
    figure = pareto_figure({"rays": points}, "time (s)", "error (µm)", "Title", 0.5)
    assert not flaws(figure)
    assert len(figure.axes[0].texts) == 6


def test_labels_keep_off_the_line_across_the_axes_and_off_lines_to_other_points():
    """Alternatives whose error is just above what the reference can tell."""
    floor = 1.0
    points = [Point(f"setting {n}", 1.0 + 0.02 * n, floor * 1.02) for n in range(5)]
    figure = pareto_figure({"rays": points}, "time (s)", "error (µm)", "Title", floor)
    assert not flaws(figure)
    (axes,) = figure.axes
    level = axes.transData.transform((1.0, floor))[1]
    boxes = {text: Text.get_window_extent(text) for text in axes.texts}
    assert not any(box.y0 < level < box.y1 for box in boxes.values())
    for text, box in boxes.items():
        if not text.arrow_patch.get_visible():
            continue
        start, end = axes.transData.transform(text.xy), 0.5 * (box.min + box.max)
        for share in np.linspace(0.0, 1.0, 100):
            x, y = start + share * (end - start)
            assert not any(
                other.x0 < x < other.x1 and other.y0 < y < other.y1
                for name, other in boxes.items()
                if name is not text
            )


def test_points_bars_and_bounds_are_where_the_numbers_say():
    bounds = {"cubic": [(0.1, 0.5), (0.2, 0.9)]}
    near = GainRange("near", (10.0, 100.0), bounds, {"cubic, blind": {100.0: (0.4, 0.1, 0.8)}})
    far = GainRange("far", judged={"sweep, by depth": {50.0: (-0.2, -0.3, -0.1)}})
    figure = coding_gain_figure([near, far])
    assert not flaws(figure)
    left, right = figure.axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in left.lines}
    assert lines["cubic, one linear filter"] == [[10.0, 0.1], [100.0, 0.2]]
    assert lines["cubic, a filter for each depth"] == [[10.0, 0.5], [100.0, 0.9]]
    (bars,) = left.containers
    (segment,) = bars.lines[2][0].get_segments()
    assert segment.round(12).tolist() == [[100.0, 0.1], [100.0, 0.8]]
    assert left.get_xscale() == "log" and left.get_title() == "near"
    # A range without a bound has its points alone.
    assert "cubic, one linear filter" not in {line.get_label() for line in right.lines}
    assert len(figure.legends) == 1
