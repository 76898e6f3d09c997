"""A sheet draws rays to where they end, whatever turns the axes."""

import pytest

from dolens import load_lens
from dolens.plotting.small_sections import lens_sheet_figure

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
