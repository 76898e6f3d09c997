"""Logarithmic axes have round numbers on them, and at least two."""

import math

import pytest
from matplotlib.figure import Figure

from dolens.plotting.style import log_ticks


def ticks(low, high, most=8):
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(low, high))
    log_ticks(axes.xaxis, most)
    places = [float(place) for place in axes.xaxis.get_majorticklocs()]
    texts = axes.xaxis.get_major_formatter().format_ticks(places)
    return [(p, t) for p, t in zip(places, texts, strict=True) if low <= p <= high]


@pytest.mark.parametrize(
    ("low", "high", "places"),
    [
        (0.9, 110.0, [1, 2, 5, 10, 20, 50, 100]),
        (1.0, 12.0, [1, 1.5, 2.5, 4, 6, 10]),
        (31.15, 31.95, [31.2, 31.3, 31.4, 31.5, 31.6, 31.7, 31.8, 31.9]),
    ],
)
def test_an_axis_of_few_decades_has_round_numbers(low, high, places):
    assert [place for place, _ in ticks(low, high)] == pytest.approx(places, rel=1e-12)


@pytest.mark.parametrize("decades", [3.0, 9.0, 20.0])
def test_an_axis_of_many_decades_has_whole_powers_of_ten(decades):
    places = [place for place, _ in ticks(1e-5, 1e-5 * 10.0**decades)]
    assert 2 <= len(places) <= 9
    assert all(math.log10(p) == pytest.approx(round(math.log10(p)), abs=1e-9) for p in places)


def test_numbers_are_plain_where_they_are_short():
    assert [text for _, text in ticks(0.9, 9000.0)] == ["1", "10", "100", "1000"]
