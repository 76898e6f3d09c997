"""Titles of a design's figures say which rays they are of."""

import pytest
from hydra.utils import instantiate
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dolens.experiments.design.figures import pupil_note
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens
from dolens.optimize import MeritSettings


@pytest.fixture
def figures(composed):
    """Of the aspheric singlet as it begins; its merit has another pupil than its stop."""
    cfg = composed("experiment=asphere")
    return instantiate(cfg.module)(lens=build_lens(RunSettings.of(cfg))).figures()


def title_of(figure):
    return figure.get_suptitle() or figure.axes[0].get_title()


@pytest.mark.parametrize("name", ["spots", "ray_fans", "modulation", "rms_curves"])
def test_figures_of_another_pupil_than_the_headline_say_so(figures, name):
    title = title_of(figures[name]())
    assert "the whole stop" in title
    assert "(rms_spot_um: 31×31 rays over ±15 mm)" in title


def test_the_title_of_a_narrow_figure_is_not_cut_off(figures):
    figure = figures["spots"]()
    FigureCanvasAgg(figure).draw()
    title = figure._suptitle.get_window_extent()
    assert 0.0 < title.x0 < title.x1 < figure.bbox.width


def test_only_other_rays_and_centres_are_worth_a_line():
    assert pupil_note(MeritSettings()) == ""
    assert "the first surface" in pupil_note(MeritSettings(sampling="square_grid"))
    assert "one centroid for all colours" in pupil_note(
        MeritSettings(reference_spectrum="polychromatic")
    )
    assert "chief ray" in pupil_note(MeritSettings(reference="chief"))
