"""Figures of a search show every trial, the best so far, and the front of two objectives."""

import pytest

from dolens.plotting import SearchTrial, search_history_figure, trade_off_figure


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
