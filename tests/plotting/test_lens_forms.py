"""Figures of a search for lenses: one scale for all forms, and nothing covers anything."""

import numpy as np
import pytest
from matplotlib.text import Text
from overlaps import flaws

from dolens import load_lens
from dolens.errors import InputError
from dolens.plotting.search import search_course_figure, starts_figure
from dolens.plotting.small_sections import FormPicture, form_section, forms_figure


@pytest.fixture(scope="module")
def pictures():
    triplet, gauss = (load_lens(n).requires_grad_(False) for n in ("cooke_triplet", "double_gauss"))
    # One lens is twice as long as the other.
    problem = "back focus, thinnest glass, distortion, and many other things besides " * 3
    return [
        FormPicture(form_section(triplet), "1", "7.2 µm    + − | +"),
        FormPicture(form_section(gauss), "2", "8.1 µm    + (+ −) | (− +) +", problem),
        FormPicture(form_section(triplet), "3"),
    ]


def words(figure):
    return [text.get_text() for text in figure.findobj(Text)]


def test_all_forms_have_one_scale_and_no_text_is_cut(pictures):
    figure = forms_figure(pictures, title="Forms")
    assert flaws(figure) == []
    figure.canvas.draw()
    scales = []
    for axes in figure.axes:
        (low, high), box = axes.get_xlim(), axes.get_window_extent()
        scales.append(box.width / (high - low))
        low, high = axes.get_ylim()
        scales.append(box.height / (high - low))
    assert len(figure.axes) == 3 and max(scales) == pytest.approx(min(scales), rel=1e-3)
    assert any(text.endswith("…") for text in words(figure))
    assert "20°" in words(figure) and any(text.endswith(" mm") for text in words(figure))


def test_beams_that_apertures_clip_are_drawn_as_far_as_they_pass(pictures):
    for fan in pictures[1].section.drawing.fans:
        assert len(fan.paths) == 3
    with pytest.raises(InputError, match="no lens"):
        forms_figure([])


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
