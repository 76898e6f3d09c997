"""Figures of a design are over the rays of its headline number, and say which those are."""

import math

import numpy as np
import pytest
from overlaps import flaws

from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.experiments.design.merit_rays import rays_text, reference_text
from dolens.experiments.design.states import spot_table
from dolens.optics.paraxial import first_order
from dolens.optimize import MeritSettings


@pytest.fixture
def module(made):
    """The aspheric singlet as it begins; its merit has another pupil than its stop."""
    return made("experiment=asphere")


def test_the_spots_are_of_the_very_rays_of_the_headline(module):
    """31×31 rays over ±15 mm, although the stop is wider; the title has both numbers."""
    figure = module.figures()["spots"]()
    (drawn,) = (line for line in figure.axes[0].get_lines() if line.get_gid() == "spot")
    points = np.stack(drawn.get_data(), -1)
    assert len(points) == 31 * 31
    rms = math.sqrt(((points - points.mean(0)) ** 2).sum(-1).mean())
    headline = spot_table(module.lens, module.evaluation).mean
    assert rms == pytest.approx(headline, rel=1e-9)
    title = figure.get_suptitle()
    assert f"mean RMS radius {headline:.4g} µm, 31×31 rays over ±15 mm" in title
    whole = spot_diagram(module.lens, conditions(module.lens, [(0.0, 0.0)], [532.8])).rms
    printed = float(title.partition("over the whole stop: ")[2].partition(" ")[0])
    assert printed == pytest.approx(1e3 * float(whole), rel=5e-3)
    far = np.linalg.norm(points, axis=1).max()
    assert figure.axes[0].get_title().endswith(f"RMS {headline:.3g}, max {far:.3g} µm")


def test_curves_and_contrast_are_of_the_headline_s_pupil(module):
    figures = module.figures()
    curve = figures["rms_curves"]().axes[0].get_lines()[0]
    at = np.interp(532.8, *curve.get_data())
    assert at == pytest.approx(spot_table(module.lens, module.evaluation).mean, rel=0.02)
    figure = figures["modulation"]()
    assert "a square of ±15 mm" in figure.get_suptitle()
    limits = [
        line for line in figure.axes[0].get_lines() if line.get_label() == "diffraction limit"
    ]
    # A square of 30 mm has the triangle 1 - ν·λ·f/D (Goodman).
    frequency, limit = limits[0].get_data()
    efl = float(first_order(module.lens.system(), 532.8).efl)
    np.testing.assert_allclose(limit, 1.0 - frequency * 532.8e-6 * efl / 30.0, atol=1e-3)


def test_before_and_after_are_in_one_figure_on_one_scale(module):
    figures = module.figures()
    for name in ("layout", "spots_before_after", "modulation"):
        before, after = figures[name]().axes[:2]
        assert before.get_xlim() == after.get_xlim() and before.get_ylim() == after.get_ylim()


@pytest.mark.parametrize(
    "name", ["layout", "spots", "spots_before_after", "ray_fans", "modulation", "rms_curves"]
)
def test_figures_of_a_design_can_be_printed(module, name):
    assert not flaws(module.figures()[name]())


def test_comparisons_name_the_apertures_of_both_lenses(module):
    """The curvature of the first surface sets the focal length, and so the F-number."""
    module.initial.surfaces["1"].curvature.data.mul_(0.5)
    first, last = (first_order(lens.system(), 532.8) for lens in (module.initial, module.lens))
    title = module.figures()["spots_before_after"]().get_suptitle().split("\n")[0]
    assert (
        f"F/{float(first.working_f_number):.3g} → F/{float(last.working_f_number):.3g} at 532.8 nm"
        in title
    )


def test_the_history_begins_before_the_first_iteration(module):
    module.history = [{"train/merit": 8.0, "train/damping": 1e-3}]
    module.initial_merit = 600.0
    merit, damping = module.figures()["history"]().axes
    np.testing.assert_array_equal(merit.get_lines()[0].get_data(), [[0, 1], [600.0, 8.0]])
    np.testing.assert_array_equal(damping.get_lines()[0].get_ydata(), [math.nan, 1e-3])


def test_other_rays_and_references_are_named():
    assert rays_text(MeritSettings()) == "rays over the whole stop"
    assert reference_text(MeritSettings()) == ""
    assert "the first surface" in rays_text(MeritSettings(sampling="square_grid"))
    assert "one centroid for all wavelengths" in reference_text(
        MeritSettings(reference_spectrum="polychromatic")
    )
    assert "chief rays" in reference_text(MeritSettings(reference="chief"))
