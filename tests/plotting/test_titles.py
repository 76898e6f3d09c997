"""Titles are never wider than their figures."""

import pytest
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from overlaps import flaws

from dolens import load_lens
from dolens.plotting import before_after_figure, history_figure
from dolens.plotting.style import TITLE, draw_axes_title, draw_title, legend_below

LONG = "Tilted singlet with a freeform corrector: f = 49.83 mm, F/4.98 at 587.6 nm\nmean RMS"


@pytest.mark.parametrize("width", [2.2, 3.0, 4.6])
def test_a_title_that_is_too_wide_is_broken_and_the_figure_grows_with_it(width):
    figure = Figure(figsize=(width, 3.0), layout="constrained")
    draw_title(figure, LONG)
    assert not any("cut" in flaw for flaw in flaws(figure))
    lines = figure.get_suptitle().split("\n")
    # Every word is there, in its order, and the line that was given stays its own.
    assert " ".join(lines).split() == LONG.split() and lines[-1] == "mean RMS"
    added = len(lines) - 2
    assert added and figure.get_figheight() == pytest.approx(3.0 + added * 1.3 * TITLE / 72.0)


def test_a_title_breaks_behind_a_colon_and_keeps_numbers_with_their_units():
    figure = Figure(figsize=(4.6, 3.0))
    draw_title(figure, LONG)
    assert figure.get_suptitle().split("\n")[:2] == [
        "Tilted singlet with a freeform corrector:",
        "f = 49.83 mm, F/4.98 at 587.6 nm",
    ]


def test_a_title_that_fits_stays_as_it_is():
    figure = Figure(figsize=(9.0, 3.0))
    draw_title(figure, LONG)
    draw_axes_title(figure.add_subplot(), LONG)
    assert figure.get_suptitle() == figure.axes[0].get_title() == LONG
    assert figure.get_figheight() == 3.0
    draw_title(Figure(), None)


def test_titles_of_axes_with_a_long_name_fit_too(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    lens.name = "A triplet whose name is as long as a catalogue has"
    assert not flaws(before_after_figure(lens, lens, rays=3))
    assert not flaws(history_figure([3.0, 2.0, 1.0], title=f"{lens.name}: history of the design"))


def test_a_legend_has_fewer_columns_where_the_figure_is_narrow():
    handles = [Line2D([], [], label=f"{wave} nm") for wave in range(400, 405)]
    for width, columns in ((7.2, 5), (3.0, 3)):
        figure = Figure(figsize=(width, 2.0), layout="constrained")
        legend = legend_below(figure, handles, 5)
        assert legend._ncols == columns
        assert [text.get_text() for text in legend.get_texts()] == [h.get_label() for h in handles]
        assert not flaws(figure)
