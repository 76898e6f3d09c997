"""Sections, tables and pages of lenses with mirrors and coordinate breaks."""

import json
import re

import numpy as np
import pytest
import torch

from dolens.analysis.spot_diagram import spot_diagram
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.lens_page.page import write_page
from dolens.manufacturing.glass_elements import glass_elements
from dolens.plotting import layout_figure
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.exit_pupil import axial_exit_pupil
from tests.optics.test_coordinate_breaks import newtonian

F64 = torch.float64


@pytest.fixture(scope="module")
def telescope():
    lens = newtonian()
    lens.name = "Newtonian"
    return lens


def drawn(figure, gid):
    lines = [line for line in figure.axes[0].get_lines() if line.get_gid() == gid]
    return [np.stack(line.get_data(), -1) for line in lines]


def test_a_newtonian_is_drawn_where_it_stands(telescope):
    figure = layout_figure(telescope, rays=5)
    (primary,), (flat,) = drawn(figure, "surface 1"), drawn(figure, "surface 3")
    assert abs(primary[:, 1]).max() == pytest.approx(100.0)
    # z and y: 45° to the axis, about the point 800 mm in front of the primary.
    slope = (flat[-1] - flat[0]) / (flat[-1, 1] - flat[0, 1])
    assert slope[0] == pytest.approx(1.0) and flat.mean(0) == pytest.approx([-800.0, 0.0])
    assert not drawn(figure, "surface 2") and not drawn(figure, "surface 4")
    (sensor,) = drawn(figure, "sensor")
    assert sensor[:, 1] == pytest.approx([-200.0, -200.0])
    paths = drawn(figure, "ray")
    assert len(paths) == 5
    for path in paths:
        assert len(path) == 4
        assert path[-1] == pytest.approx([-800.0, -200.0], abs=1e-9)
    low, high = figure.axes[0].get_ylim()
    assert low < -200.0 and high > 100.0


def test_a_table_shows_mirrors_and_breaks_as_what_they_are(telescope):
    text = repr(telescope)
    lines = text.splitlines()
    assert "mirror" in lines[3] and "conic" in lines[3]
    assert "coordinate_break" in lines[4] and "tilt_x 45°" in lines[4]
    assert "1e-06" not in text
    assert "coordinate_break" in telescope._repr_html_()


def test_a_page_of_a_folded_lens_has_a_viewer_and_its_breaks(telescope, tmp_path):
    path = tmp_path / "page.html"
    write_page(telescope, path)
    text = path.read_text(encoding="utf-8")
    assert "Coordinate breaks" in text
    data = json.loads(re.search(r'id="viewer-data"[^>]*>(.*?)</script>', text, re.S)[1])
    kinds = [mesh["kind"] for mesh in data["meshes"]]
    assert kinds.count("mirror") == 2 and "glass" not in kinds


def test_spots_and_wavefronts_behind_an_odd_number_of_mirrors_are_those_of_the_mirror_alone(
    telescope,
):
    """A flat moves nothing: the folded telescope and its paraboloid have the same wavefront."""
    row = {"type": "conic", "radius": -2000.0, "conic": -1.0, "semi_diameter": 100.0,
           "material": "mirror"}  # fmt: skip
    straight = lens_from_prescription({"surfaces": {"1": row}, "sensor": {"distance": -1000.0}})
    fields = [[0.0, 0.0], [0.0, 0.2]]
    found, expected = (
        spot_diagram(lens, torch.tensor(fields, dtype=F64), torch.tensor([550.0]).double(), 400)
        for lens in (telescope, straight)
    )
    assert torch.allclose(found.rms, expected.rms, rtol=1e-6, atol=1e-9)
    points = ObjectPoints.at_infinity(fields)
    waves = [
        pupil_wavefront(lens.system(), points, 550.0, samples=16) for lens in (telescope, straight)
    ]
    for found in waves:
        assert float(found.rms[0].detach()) < 1e-9
        assert float(found.strehl_ratio[0].detach()) == pytest.approx(1.0)
    assert torch.allclose(waves[0].rms, waves[1].rms, rtol=1e-3, atol=1e-9)


def test_what_needs_a_straight_axis_says_so(telescope):
    with pytest.raises(InputError, match="rendering: surface 1 is a mirror"):
        axial_exit_pupil(telescope.system(), [550.0])
    with pytest.raises(InputError, match="drawings and solids: surface 1 is a mirror"):
        glass_elements(telescope)
