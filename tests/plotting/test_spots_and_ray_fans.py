"""Spots and ray fans show the numbers of an analysis, in the units that they name."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.modulation_transfer import modulation
from dolens.analysis.ray_intercepts import RayFans, ray_fans
from dolens.analysis.spot_diagram import (
    SpotDiagram,
    rms_against_field,
    rms_against_wavelength,
    spot_diagram,
)
from dolens.errors import InputError
from dolens.plotting import (
    modulation_figure,
    ray_fans_figure,
    rms_curves_figure,
    spots_comparison_figure,
    spots_figure,
)
from dolens.plotting.style import spectral_colour
from dolens.prescriptions import lens_from_prescription
from tests.plotting.artists import by_gid
from tests.plotting.overlaps import flaws

LINES = torch.tensor([656.2725, 486.1327], dtype=torch.float64)
FIELDS = torch.tensor([[0.0, 0.0], [0.0, 14.0], [3.0, 4.0]], dtype=torch.float64)


def texts(axes):
    return [text.get_text() for text in axes.texts]


@pytest.fixture(scope="module")
def spots(triplet):
    return spot_diagram(
        triplet, conditions(triplet, [(0.0, 0.0), (0.0, 14.0), (0.0, 35.0)], LINES), rays=80
    )


def test_spots_are_drawn_about_the_common_centroid_in_micrometres(spots):
    figure = spots_figure(spots, title="Triplet")
    grid = np.reshape(figure.axes, (3, 2))
    for field in range(2):
        for wave in range(2):
            axes = grid[field, wave]
            (drawn,) = by_gid(axes, "spot")
            centre = spots.polychromatic_centroid[field]
            expected = 1e3 * (spots.intercepts[field, wave] - centre)
            np.testing.assert_allclose(np.stack(drawn.get_data(), -1), expected)
            assert drawn.get_color() == spectral_colour(float(LINES[wave]))
            (airy,) = by_gid(axes, "airy")
            assert airy.radius == pytest.approx(1e3 * float(spots.airy_radius[wave]))
            middle = 1e3 * (spots.centroid[field, wave] - centre)
            assert airy.center == pytest.approx(middle.tolist())
            rms = f"RMS {1e3 * float(spots.rms[field, wave]):.3g}, "
            assert axes.get_title().partition("\n")[2 * (field == 0)].startswith(rms)
    assert {axes.get_xlim() for axes in figure.axes} == {figure.axes[0].get_ylim()}
    assert figure.axes[0].get_xlim()[1] > np.nanmax(np.abs(drawn.get_data()))
    headings = [axes.get_title().partition("\n")[0] for axes in grid[0]]
    assert headings == ["656.273 nm", "486.133 nm"]
    assert grid[1, 0].get_ylabel() == "14°\ny (µm)" and grid[2, 1].get_xlabel() == "x (µm)"
    assert grid[2, 0].get_title() == "no light passes"
    assert figure.get_suptitle() == "Triplet"


def test_overlaid_spots_have_a_panel_a_field(spots):
    figure = spots_figure(spots, overlaid=True)
    headings = [axes.get_title().partition("\n")[0] for axes in figure.axes]
    assert headings == ["0°", "14°", "35°"]
    colours = {line.get_color() for line in by_gid(figure.axes[1], "spot")}
    assert colours == {spectral_colour(float(line)) for line in LINES}
    rms = 1e3 * float(spots.polychromatic_rms[1])
    assert figure.axes[1].get_title().partition("\n")[2].startswith(f"RMS {rms:.3g},")


def test_five_overlaid_fields_wrap(triplet):
    shape = (5, 1, 4)
    blank = torch.zeros(*shape[:2], dtype=torch.float64)
    many = SpotDiagram(
        conditions(triplet, torch.arange(10.0).reshape(5, 2), LINES[:1], 500.0),
        torch.zeros(*shape, 2), torch.ones(shape, dtype=torch.bool), torch.ones(4) / 4,
        torch.zeros(5, 2), torch.zeros(5, 1, 2), blank, blank, torch.zeros(5, 2), blank[:, 0],
        torch.tensor([2e-3]),
    )  # fmt: skip
    figure = spots_figure(many, overlaid=True)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    headings = [axes.get_title().partition("\n")[0] for axes in shown[:2]]
    assert headings == ["1 mm", "(2, 3) mm"]
    assert len(shown) == 5 and shown[4].get_subplotspec().rowspan.start == 1


def test_ray_fans_share_one_scale_and_leave_out_what_does_not_pass(triplet):
    coordinate = torch.linspace(-1.0, 1.0, 5, dtype=torch.float64)
    tangential = coordinate.expand(3, 2, 5) * torch.tensor([1.0, 2.0]).double()[:, None]
    tangential = tangential.clone()
    tangential[1, :, 0] = math.nan
    tangential[2] = math.nan
    where = conditions(triplet, FIELDS, LINES)
    fans = RayFans(where, coordinate, tangential, 3.0 * tangential)
    figure = ray_fans_figure(fans)
    grid = np.reshape(figure.axes, (3, 2))
    assert grid[0, 0].get_title() == "tangential: y" and grid[0, 1].get_title() == "sagittal: x"
    lines = by_gid(grid[1, 1], "fan")
    assert [line.get_color() for line in lines] == [spectral_colour(float(w)) for w in LINES]
    np.testing.assert_array_equal(lines[1].get_ydata(), 3.0 * tangential[1, 1])
    assert {axes.get_ylim() for axes in figure.axes} == {(-1.08 * 6.0, 1.08 * 6.0)}
    assert grid[1, 0].get_ylabel() == "14°\naberration (µm)"
    assert grid[2, 0].get_xlabel() == "y on the stop / semi-diameter"
    assert texts(grid[2, 1]) == ["no light passes"]


WAVES = [656.2725, 587.5618, 486.1327]
FOUR_FIELDS = [(0.0, 0.0), (0.0, 10.0), (0.0, 14.0), (0.0, 20.0)]


@pytest.fixture(scope="module")
def triplet_spots(triplet):
    return spot_diagram(triplet, conditions(triplet, FOUR_FIELDS, WAVES), rays=200)


@pytest.mark.parametrize("overlaid", [False, True])
def test_numbers_of_spots_stand_beside_them(triplet_spots, overlaid):
    """The supplement's triplet at 20°, whose spots once lay under their numbers."""
    assert not flaws(spots_figure(triplet_spots, overlaid, "Cooke triplet"))


def test_no_airy_disc_is_cut():
    """The camera lens's discs lie beside their fields' centres by its lateral colour."""
    nikon = load_lens("nikon_optimized").requires_grad_(False)
    spots = spot_diagram(nikon, conditions(nikon, [(0.0, 0.0), (0.0, 32.45)], WAVES), rays=100)
    figure = spots_figure(spots)
    assert not flaws(figure)
    for axes in figure.axes:
        for disc in (patch for patch in axes.patches if patch.get_gid() == "airy"):
            reach = np.abs(disc.center) + disc.radius
            assert (reach < axes.get_xlim()[1]).all()


def test_spots_before_and_after_share_their_scale_and_small_ones_are_magnified(triplet_spots):
    centre = triplet_spots.polychromatic_centroid[:, None, None]
    small = replace(
        triplet_spots,
        intercepts=centre + 0.05 * (triplet_spots.intercepts - centre),
        airy_radius=0.05 * triplet_spots.airy_radius,
        chief=triplet_spots.polychromatic_centroid,
    )
    figure = spots_comparison_figure({"initial": triplet_spots, "final": small}, "Triplet")
    assert not flaws(figure)
    grid = np.reshape(figure.axes, (len(FOUR_FIELDS), 3))
    assert {axes.get_xlim() for axes in grid[:, :2].flat} == {grid[0, 0].get_ylim()}
    # What the third column says of its scale is so.
    factor = float(grid[0, 2].get_title().partition("×")[2].partition("\n")[0])
    assert grid[0, 0].get_xlim()[1] / grid[0, 2].get_xlim()[1] == pytest.approx(factor, rel=0.05)
    same = spots_comparison_figure({"initial": triplet_spots, "final": triplet_spots})
    assert len(same.axes) == 2 * len(FOUR_FIELDS)


def test_fans_curves_and_contrast(triplet):
    assert not flaws(
        ray_fans_figure(
            ray_fans(triplet, conditions(triplet, FOUR_FIELDS, WAVES)), "Fans", pupil=0.6
        )
    )
    curves = rms_curves_figure(
        rms_against_field(triplet, conditions(triplet, wavelengths=WAVES), (0.0, 20.0), 5, 100),
        rms_against_wavelength(triplet, conditions(triplet, FOUR_FIELDS), (486.0, 656.0), 5, 100),
    )
    assert not flaws(curves)
    frequencies = torch.linspace(0.0, 60.0, 11, dtype=torch.float64)
    six = [(0.0, y) for y in (0.0, 5.0, 9.0, 12.0, 16.0, 20.0)]
    found = modulation(triplet, conditions(triplet, six, WAVES), frequencies, rays=200)
    figure = modulation_figure({"initial": found, "final": found}, "MTF")
    assert not flaws(figure)
    left, right = figure.axes
    assert left.get_xlim() == right.get_xlim() and left.get_ylim() == right.get_ylim()
    # Six fields and three kinds of line, not thirteen lines.
    (box,) = figure.legends
    assert len(box.get_texts()) == 9
    assert len({handle.get_color() for handle in box.legend_handles[:6]}) == 6


def test_an_afocal_lens_has_spots_without_an_airy_disc():
    window = lens_from_prescription(
        {
            "name": "window",
            "stop": 1,
            "wavelengths": [587.56],
            "fields": {"angles": [[0, 0]]},
            "surfaces": {
                1: {"type": "plane", "semi_diameter": 5, "thickness": 6, "material": "1.5"},
                2: {"type": "plane", "semi_diameter": 7, "material": "air"},
            },
            "sensor": {"distance": 25, "diameter": 20},
        }
    )
    (axes,) = window.spots().axes
    assert not [artist for artist in axes.get_children() if artist.get_gid() == "airy"]
    assert axes.get_xlim()[1] == pytest.approx(5000.0, rel=0.1)  # the beam's own half width, µm
    with pytest.raises(InputError, match="is afocal"):
        window.mtf()
