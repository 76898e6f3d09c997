"""The figure of where coding wins shows what it is given."""

from dolens.plotting.pareto import GainRange, coding_gain_figure


def test_points_bars_and_bounds_are_where_the_numbers_say():
    bounds = {"cubic": [(0.1, 0.5), (0.2, 0.9)]}
    near = GainRange("near", (10.0, 100.0), bounds, {"cubic, blind": {100.0: (0.4, 0.1, 0.8)}})
    far = GainRange("far", judged={"sweep, by depth": {50.0: (-0.2, -0.3, -0.1)}})
    figure = coding_gain_figure([near, far])
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
