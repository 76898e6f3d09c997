"""Figures of wavefronts, Zernike coefficients, Strehl ratios and footprints."""

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.footprint import footprint
from dolens.diffraction.point_spread import strehl_ratios
from dolens.diffraction.wavefront_map import wavefront_maps
from dolens.plotting.footprint import footprint_figure
from dolens.plotting.wavefront_maps import strehl_figure, wavefront_maps_figure, zernike_figure
from tests.plotting.artists import by_gid
from tests.plotting.overlaps import flaws

FIELDS = [(0.0, 0.0), (0.0, 20.0), (0.0, 45.0)]


@pytest.fixture(scope="module")
def maps(triplet):
    return wavefront_maps(triplet, conditions(triplet, FIELDS, [587.5618]), samples=32)


def test_a_map_shows_waves_over_the_stop_on_a_scale_about_zero(maps):
    figure = wavefront_maps_figure(maps)
    first, _, dark, *bars = figure.axes
    (mesh,) = [artist for artist in first.get_children() if isinstance(artist, QuadMesh)]
    shown = mesh.get_array()
    inside = maps.inside[0, 0].numpy()
    np.testing.assert_array_equal(shown[inside], maps.error[0, 0].numpy()[inside])
    assert shown.mask.sum() == (~inside).sum()
    assert mesh.norm.vmin == -mesh.norm.vmax == -np.abs(shown).max()
    assert first.get_title().startswith("0°\nRMS 0.199, P–V")
    assert dark.get_title() == "45°\nno light passes"
    assert [bar.get_xlabel() for bar in bars] == ["wavefront error (waves)"] * 2
    assert flaws(figure) == []


def test_bars_are_the_coefficients_with_their_names(maps):
    figure = zernike_figure(maps, "standard", 11)
    (axes,) = figure.axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names[0] == "tilt x  Z2" and names[-1] == "spherical  Z11"
    fit = maps.zernike("standard")
    widths = [bar.get_width() for bar in axes.containers[1]]
    np.testing.assert_allclose(widths, fit.coefficients[1, 0, 1:11])
    # A field in the dark has no bars.
    assert len(axes.containers) == 2
    assert axes.get_xlabel() == "standard coefficient (waves)"


def test_strehl_ratios_lie_between_none_and_one(triplet):
    (scan,) = field_scans(triplet, None, 20.0, 3)
    found = strehl_ratios(triplet, conditions(triplet, scan.fields, [587.5618]))
    figure = strehl_figure([(scan, found)])
    (axes,) = figure.axes
    lines = {line.get_gid(): line for line in axes.lines}
    np.testing.assert_array_equal(lines["peak"].get_ydata(), found.peak[:, 0])
    np.testing.assert_array_equal(lines["marechal"].get_ydata(), found.marechal[:, 0])
    assert axes.get_ylim() == (0.0, 1.02)
    assert flaws(figure) == []


def test_footprints_have_a_panel_for_each_surface_and_its_outline(triplet):
    found = footprint(triplet, conditions(triplet, FIELDS), rays=200)
    figure = footprint_figure(found)
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert len(panels) == 6
    rays = by_gid(panels[3], "rays")
    assert [len(line.get_xdata()) for line in rays] == found.passes.sum(1).tolist()
    # The stop's edge, of 3.86 mm, is drawn where its margin is zero.
    (outline,) = panels[3].collections
    radii = np.hypot(*outline.get_paths()[0].vertices.T)
    np.testing.assert_allclose(radii, 3.86, rtol=2e-3)
    assert "light to 3.8" in panels[3].get_title()
    assert flaws(figure) == []
