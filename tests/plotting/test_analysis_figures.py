"""Figures of an analysis show its numbers, in the units that they name."""

import math

import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.analysis.modulation_transfer import Modulation
from dolens.analysis.ray_fans import RayFans
from dolens.analysis.spot_diagram import RMSCurves, SpotDiagram, spot_diagram
from dolens.errors import InputError
from dolens.plotting import (
    before_after_figure,
    figure_to_image,
    history_figure,
    layout_figure,
    modulation_figure,
    ray_fans_figure,
    rms_curves_figure,
    spots_figure,
)
from dolens.plotting.style import spectral_colour

LINES = torch.tensor([656.2725, 486.1327], dtype=torch.float64)
FIELDS = torch.tensor([[0.0, 0.0], [0.0, 14.0], [3.0, 4.0]], dtype=torch.float64)


def by_gid(axes, gid):
    return [artist for artist in axes.get_children() if artist.get_gid() == gid]


def texts(axes):
    return [text.get_text() for text in axes.texts]


def inside(figure):
    """Whether everything drawn is within the figure."""
    figure_to_image(figure)
    box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
    return box.x0 > -0.01 and box.y0 > -0.01 and box.x1 < width + 0.01 and box.y1 < height + 0.01


@pytest.fixture(scope="module")
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)


@pytest.fixture(scope="module")
def spots(triplet):
    return spot_diagram(triplet, [(0.0, 0.0), (0.0, 14.0), (0.0, 35.0)], LINES, rays=80)


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
    assert inside(figure)


def test_overlaid_spots_have_a_panel_a_field(spots):
    figure = spots_figure(spots, overlaid=True)
    headings = [axes.get_title().partition("\n")[0] for axes in figure.axes]
    assert headings == ["0°", "14°", "35°"]
    colours = {line.get_color() for line in by_gid(figure.axes[1], "spot")}
    assert colours == {spectral_colour(float(line)) for line in LINES}
    rms = 1e3 * float(spots.polychromatic_rms[1])
    assert figure.axes[1].get_title().partition("\n")[2].startswith(f"RMS {rms:.3g},")
    assert inside(figure)


def test_five_overlaid_fields_wrap():
    shape = (5, 1, 4)
    blank = torch.zeros(*shape[:2], dtype=torch.float64)
    many = SpotDiagram(
        torch.arange(10.0).reshape(5, 2), "mm", LINES[:1], 587.6, torch.zeros(*shape, 2),
        torch.ones(shape, dtype=torch.bool), torch.ones(4) / 4, torch.ones(1),
        torch.zeros(5, 2), torch.zeros(5, 1, 2), blank, blank, torch.zeros(5, 2), blank[:, 0],
        torch.tensor([2e-3]),
    )  # fmt: skip
    figure = spots_figure(many, overlaid=True)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    headings = [axes.get_title().partition("\n")[0] for axes in shown[:2]]
    assert headings == ["1 mm", "(2, 3) mm"]
    assert len(shown) == 5 and shown[4].get_subplotspec().rowspan.start == 1


def test_ray_fans_share_one_scale_and_leave_out_what_does_not_pass():
    coordinate = torch.linspace(-1.0, 1.0, 5, dtype=torch.float64)
    tangential = coordinate.expand(3, 2, 5) * torch.tensor([1.0, 2.0]).double()[:, None]
    tangential = tangential.clone()
    tangential[1, :, 0] = math.nan
    tangential[2] = math.nan
    fans = RayFans(FIELDS, "°", LINES, 587.6, coordinate, tangential, 3.0 * tangential)
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
    assert inside(figure)


def test_modulation_is_drawn_below_its_limit():
    frequency = torch.linspace(0.0, 50.0, 6).double()
    curves = torch.linspace(1.0, 0.5, 6).double() * torch.tensor([[1.0], [0.8], [math.nan]])
    limit = torch.linspace(1.0, 0.9, 6)
    mtf = Modulation(FIELDS, "°", LINES, frequency, curves, 0.9 * curves, limit)
    figure = modulation_figure(mtf)
    axes = figure.axes[0]
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["diffraction limit"].get_linestyle() == "--"
    np.testing.assert_array_equal(lines["diffraction limit"].get_ydata(), limit)
    np.testing.assert_array_equal(lines["14° tangential"].get_ydata(), curves[1])
    np.testing.assert_array_equal(lines["14° sagittal"].get_ydata(), 0.9 * curves[1])
    assert lines["14° tangential"].get_linestyle() == "-"
    dots = lines["14° sagittal"]._unscaled_dash_pattern
    assert dots[1] is not None and lines["14° tangential"]._unscaled_dash_pattern[1] is None
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[:3] == ["0°", "14°", "(3, 4)° (no light passes)"]
    assert names[3:] == ["tangential", "sagittal", "diffraction limit"]
    assert axes.get_xlabel() == "frequency (cycles/mm)" and axes.get_xlim() == (0.0, 50.0)


def test_rms_curves_are_in_micrometres_over_degrees_and_nanometres():
    rms = torch.tensor([[1.0, 2.0], [3.0, math.nan], [5.0, 6.0]], dtype=torch.float64) * 1e-3
    curves = RMSCurves(FIELDS, "°", LINES, rms, rms[:, 0], torch.tensor([2e-3, 8e-3]))
    left, right = rms_curves_figure(curves, curves, "RMS").axes
    lines = {line.get_label(): line for line in left.get_lines()}
    np.testing.assert_allclose(lines["656.273 nm"].get_data(), [[0, 14, 5], [1, 3, 5]])
    np.testing.assert_allclose(lines["all, common centroid"].get_ydata(), [1, 3, 5])
    assert left.get_xlabel() == "field (°)"
    assert left.get_ylabel() == "RMS spot radius (µm)"
    lines = {line.get_label(): line for line in right.get_lines()}
    np.testing.assert_allclose(lines["14°"].get_ydata(), [3, math.nan])
    np.testing.assert_allclose(lines["Airy radius"].get_ydata(), [2, 8])
    assert right.get_xlabel() == "wavelength (nm)"
    # One scale, which holds everything.
    assert left.get_ylim() == right.get_ylim() and left.get_ylim()[1] > 8.0
    assert len(rms_curves_figure(against_wavelength=curves).axes) == 1
    with pytest.raises(InputError, match="needs curves"):
        rms_curves_figure()


def test_fields_on_both_sides_of_the_axis_are_plotted_on_both_sides():
    """A lens that is tilted in y blurs fields above the axis unlike those below."""
    fields = torch.tensor([[0.0, -2.0], [0.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    rms = torch.tensor([[3.0], [1.0], [2.0]], dtype=torch.float64) * 1e-3
    curves = RMSCurves(fields, "°", LINES[:1], rms, rms[:, 0], torch.tensor([2e-3]))
    (axes,) = rms_curves_figure(curves).axes
    np.testing.assert_allclose(axes.get_lines()[0].get_data(), [[-2, 0, 2], [3, 1, 2]])
    assert axes.get_xlabel() == "field along y (°)" and axes.get_xlim() == (-2.0, 2.0)


def test_before_and_after_share_their_scale(root, triplet):
    longer = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    longer.sensor_distance.add_(20.0)
    figure = before_after_figure(triplet, longer, fields_deg=(0.0, 14.0), rays=3)
    above, below = figure.axes
    assert above.get_xlim() == below.get_xlim() and above.get_ylim() == below.get_ylim()
    assert above.get_aspect() == below.get_aspect() == 1.0
    sensors = [by_gid(axes, "sensor")[0].get_xdata()[0] for axes in figure.axes]
    assert sensors[1] - sensors[0] == pytest.approx(20.0)
    assert above.get_title().startswith("(a) Cooke triplet, initial: f = 50.02 mm, F/4.9")
    alone = layout_figure(triplet, fields_deg=(0.0, 14.0), rays=3).axes[0]
    for one, other in zip(by_gid(above, "ray"), by_gid(alone, "ray"), strict=True):
        np.testing.assert_array_equal(one.get_xydata(), other.get_xydata())
    assert inside(figure)
    named = before_after_figure(triplet, longer, titles=("start", "end"))
    assert [axes.get_title() for axes in named.axes] == ["start", "end"]


@pytest.mark.parametrize("name", ["nikon", "wavefront_coding"])
def test_labels_of_wide_and_slender_lenses_stay_within_the_figure(root, name):
    lens = load_lens(root / f"conf/lens/{name}.yaml").requires_grad_(False)
    assert inside(before_after_figure(lens, lens, fields_deg=(0.0, 10.0), rays=3))


def test_a_history_is_logarithmic_with_its_damping_below():
    figure = history_figure([10.0, 1.0, 0.1], [1e-3, 1e-4, 1e-5])
    merit, damping = figure.axes
    assert merit.get_yscale() == damping.get_yscale() == "log"
    np.testing.assert_array_equal(merit.get_lines()[0].get_data(), [[0, 1, 2], [10, 1, 0.1]])
    np.testing.assert_array_equal(damping.get_lines()[0].get_ydata(), [1e-3, 1e-4, 1e-5])
    assert (merit.get_ylabel(), damping.get_ylabel()) == ("merit", "damping")
    assert damping.get_xlabel() == "iteration" and merit.get_xlabel() == ""
    (alone,) = history_figure([2.0, 1.0], iterations=[5, 9], merit_label="RMS (µm)").axes
    assert alone.get_lines()[0].get_xdata().tolist() == [5, 9]
    assert alone.get_xlabel() == "iteration" and alone.get_ylabel() == "RMS (µm)"
    with pytest.raises(InputError, match="damping"):
        history_figure([1.0, 2.0], [1.0])
