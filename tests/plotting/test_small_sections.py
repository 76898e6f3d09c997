"""Small sections of many lenses: one scale for all forms, and nothing covers anything."""

import pytest
from matplotlib.text import Text

from dolens import load_lens
from dolens.errors import InputError
from dolens.plotting.small_sections import (
    FormPicture,
    form_section,
    forms_figure,
    lens_sheet_figure,
)
from tests.plotting.overlaps import flaws


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


NAME = "published/paraboloid_off_axis_100"


def test_the_rays_of_an_off_axis_paraboloid_end_in_its_focus():
    (axes,) = lens_sheet_figure({NAME: load_lens(NAME)}, columns=1).axes
    ends = [line.get_xydata()[-1] for line in axes.lines if len(line.get_xydata()) == 4]
    # In front, stop, mirror, sensor. The focus of R = -200 mm lies 100 mm in front of a vertex at
    # z = 120 mm, on the parent's axis at y = 36 mm.
    assert len(ends) >= 3
    for end in ends:
        assert end == pytest.approx([20.0, 36.0], abs=1e-9)


def test_a_cone_is_not_called_afocal():
    lenses = {"axicon": load_lens("published/axicon_ring_focus")}
    (axes,) = lens_sheet_figure(lenses, columns=1).axes
    words = " ".join(text.get_text() for text in axes.texts) + axes.get_title()
    assert "axicon" in words and "afocal" not in words
