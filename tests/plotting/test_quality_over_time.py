"""Networks of a figure of quality against seconds are told apart, and have their intervals."""

from dolens.plotting.runs import Curve, quality_figure


def test_every_network_has_a_line_with_its_intervals():
    found = [
        Curve("one", [20.0, 70.0], [22.0, 23.0], [21.0, 22.5], [23.0, 23.5]),
        Curve("other", [20.0], [24.0], [23.0], [25.0]),
    ]
    figure = quality_figure(found)
    (axes,) = figure.axes
    assert len(axes.containers) == 2
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "other"]
    low, high = axes.get_ylim()
    assert low < 21.0 and high > 25.0
