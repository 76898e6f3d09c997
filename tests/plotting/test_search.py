"""Histories of an optimization and figures of a search: every trial, the best so far, the front."""

import numpy as np
import pytest
from matplotlib.text import Text

from dolens.errors import InputError
from dolens.plotting import (
    SearchTrial,
    history_figure,
    search_history_figure,
    trade_off_figure,
)
from dolens.plotting.search import search_course_figure, starts_figure
from tests.plotting.overlaps import flaws


@pytest.mark.parametrize(
    ("maximize", "best"), [(True, [2.0, 3.0, 3.0, 3.0]), (False, [2.0, 2.0, 1.0, 1.0])]
)
def test_the_best_so_far_is_a_staircase_and_others_are_marked(maximize, best):
    trials = [
        *(SearchTrial(0, (2.0,)), SearchTrial(1, (3.0,)), SearchTrial(2, (), "failed")),
        *(SearchTrial(3, (1.0,)), SearchTrial(4, (), "pruned")),
    ]
    (axes,) = search_history_figure(trials, "PSNR (dB)", maximize).axes
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines["trials"].get_xdata()) == [0, 1, 3]
    assert list(lines["best so far"].get_xdata()) == [0, 1, 3, 4]
    assert list(lines["best so far"].get_ydata()) == best
    assert list(lines["failed"].get_xdata()) == [2] and list(lines["pruned"].get_xdata()) == [4]
    assert axes.get_ylabel() == "PSNR (dB)" and axes.get_yscale() == "linear"


def test_values_over_decades_are_drawn_logarithmically():
    trials = [SearchTrial(0, (1.0,)), SearchTrial(1, (1000.0,))]
    assert search_history_figure(trials, "y", False).axes[0].get_yscale() == "log"


def test_the_front_is_a_line_through_its_trials():
    values = [(30.0, 2.0), (20.0, 1.0), (19.0, 3.0), (31.0, 5.0)]
    trials = [SearchTrial(number, value) for number, value in enumerate(values)]
    trials.append(SearchTrial(4, (), "failed"))
    (axes,) = trade_off_figure(trials, [0, 1, 3], ("PSNR (dB)", "cost (s)")).axes
    others, front = axes.lines[:2]
    assert list(front.get_xdata()) == [1.0, 2.0, 5.0]
    assert list(front.get_ydata()) == [20.0, 30.0, 31.0]
    assert list(others.get_xdata()) == [3.0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("cost (s)", "PSNR (dB)")
    assert {text.get_text() for text in axes.texts} == {"0", "1", "3"}


def words(figure):
    return [text.get_text() for text in figure.findobj(Text)]


def test_starts_are_counted_by_the_form_they_reached():
    points = np.stack([np.linspace(-1.0, 1.0, 40), np.cos(np.arange(40.0))], 1)
    forms = np.arange(40) % 9 - 1
    figure = starts_figure(points, forms, ("0.7 φ₁ (1)", "0.7 φ₂ (1)"), tried=1000, title="Starts")
    assert flaws(figure) == []
    shown = words(figure)
    # -1 and 0 to 3 have five starts each, the others four; 6 and 7 share a colour.
    assert {"form 1", "form 6", "2 others", "no design"} <= set(shown)
    assert "8" in shown and str(1000 - 35) in shown
    with pytest.raises(InputError, match="two of each"):
        starts_figure(points, forms[:3], ("x", "y"))


def test_the_course_of_a_search_has_the_best_so_far_and_the_forms():
    seconds = [1.0, 2.0, 5.0, 9.0]
    figure = search_course_figure(
        seconds, [9.0, 12.0, 7.0, 8.0], [9.0, 9.0, 7.0, 7.0], [1, 1, 1, 2], "merit (µm)"
    )
    assert flaws(figure) == []
    upper, lower = figure.axes
    best = next(line for line in upper.lines if line.get_label() == "best so far")
    assert list(best.get_ydata()) == [9.0, 9.0, 7.0, 7.0, 7.0]
    assert list(lower.lines[0].get_ydata()) == [1, 1, 1, 2, 2]
    assert lower.get_ylabel().startswith("forms within 25 %")
    with pytest.raises(InputError, match="as many of each"):
        search_course_figure(seconds, [1.0], [1.0], [1])


def test_a_history_is_logarithmic_with_its_damping_below():
    figure = history_figure([10.0, 1.0, 0.1], [1e-3, 1e-4, 1e-5])
    merit, damping = figure.axes
    assert merit.get_yscale() == damping.get_yscale() == "log"
    np.testing.assert_array_equal(merit.get_lines()[0].get_data(), [[0, 1, 2], [10, 1, 0.1]])
    np.testing.assert_array_equal(damping.get_lines()[0].get_ydata(), [1e-3, 1e-4, 1e-5])
    assert (merit.get_ylabel(), damping.get_ylabel()) == ("merit", "damping")
    assert damping.get_xlabel() == "iteration" and merit.get_xlabel() == ""
    (alone,) = history_figure([2.0, 1.0], iterations=[5, 9], merit_label="RMS (µm)").axes
    assert alone.get_lines()[0].get_xdata().tolist() == [5, 9]
    assert alone.get_xlabel() == "iteration" and alone.get_ylabel() == "RMS (µm)"
    with pytest.raises(InputError, match="damping"):
        history_figure([1.0, 2.0], [1.0])


def test_the_damping_is_a_strip_below_the_merit():
    figure = history_figure([100.0 / 2**n for n in range(30)], [1e-3 / 2**n for n in range(30)])
    assert not flaws(figure)
    merit, damping = (axes.get_window_extent().height for axes in figure.axes)
    assert damping < 0.25 * merit
