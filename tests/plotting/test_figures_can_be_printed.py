"""Every figure, of real small data: nothing covers anything, and every axis has its unit."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.text import Text
from overlaps import drawn_points, flaws

from dolens import load_lens
from dolens.analysis.modulation_transfer import modulation
from dolens.analysis.ray_fans import ray_fans
from dolens.analysis.spot_diagram import rms_against_field, rms_against_wavelength, spot_diagram
from dolens.plotting import (
    Point,
    before_after_figure,
    comparison_figure,
    history_figure,
    layout_figure,
    modulation_figure,
    pareto_figure,
    psf_figure,
    ray_fans_figure,
    rms_curves_figure,
    spots_comparison_figure,
    spots_figure,
)
from dolens.plotting.parameter_fits import convergence_figure, corner_figure
from dolens.plotting.pareto import GainRange, coding_gain_figure
from dolens.plotting.pictures import spot_fit_figure
from dolens.plotting.point_spread import window_of_light
from dolens.plotting.tolerances import matrix_figure, offenders_figure, yield_figure

WAVES = [656.2725, 587.5618, 486.1327]
FIELDS = [(0.0, 0.0), (0.0, 10.0), (0.0, 14.0), (0.0, 20.0)]


@pytest.fixture(scope="module")
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)


@pytest.fixture(scope="module")
def nikon(root):
    return load_lens(root / "conf/lens/nikon_optimized.yaml").requires_grad_(False)


@pytest.fixture(scope="module")
def triplet_spots(triplet):
    return spot_diagram(triplet, FIELDS, WAVES, rays=200)


def test_the_checker_finds_what_it_is_for():
    figure = history_figure([3.0, 2.0, 1.0])
    assert not flaws(figure)
    axes = figure.axes[0]
    axes.text(1.0, 2.0, "over the line", ha="center")
    axes.text(1.0, 2.0, "over it", ha="center")
    axes.set_xlabel("-3")
    axes.set_ylabel("lengths")
    found = "\n".join(flaws(figure))
    for flaw in ("points of data", "covers 'over it'", "hyphen for a minus", "lengths"):
        assert flaw in found


@pytest.mark.parametrize("overlaid", [False, True])
def test_numbers_of_spots_stand_beside_them(triplet_spots, overlaid):
    """The supplement's triplet at 20°, whose spots once lay under their numbers."""
    assert not flaws(spots_figure(triplet_spots, overlaid, "Cooke triplet"))


def test_no_airy_disc_is_cut(nikon):
    """The camera lens's discs lie beside their fields' centres by its lateral colour."""
    spots = spot_diagram(nikon, [(0.0, 0.0), (0.0, 32.45)], WAVES, rays=100)
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
    grid = np.reshape(figure.axes, (len(FIELDS), 3))
    assert {axes.get_xlim() for axes in grid[:, :2].flat} == {grid[0, 0].get_ylim()}
    # What the third column says of its scale is so.
    factor = float(grid[0, 2].get_title().partition("×")[2].partition("\n")[0])
    assert grid[0, 0].get_xlim()[1] / grid[0, 2].get_xlim()[1] == pytest.approx(factor, rel=0.05)
    same = spots_comparison_figure({"initial": triplet_spots, "final": triplet_spots})
    assert len(same.axes) == 2 * len(FIELDS)


def test_fans_curves_and_contrast(triplet):
    assert not flaws(ray_fans_figure(ray_fans(triplet, FIELDS, WAVES), "Fans", pupil=0.6))
    curves = rms_curves_figure(
        rms_against_field(triplet, WAVES, (0.0, 20.0), 5, 100),
        rms_against_wavelength(triplet, FIELDS, (486.0, 656.0), 5, 100),
    )
    assert not flaws(curves)
    frequencies = torch.linspace(0.0, 60.0, 11, dtype=torch.float64)
    six = [(0.0, y) for y in (0.0, 5.0, 9.0, 12.0, 16.0, 20.0)]
    found = modulation(triplet, six, WAVES, frequencies, rays=200)
    figure = modulation_figure({"initial": found, "final": found}, "MTF")
    assert not flaws(figure)
    left, right = figure.axes
    assert left.get_xlim() == right.get_xlim() and left.get_ylim() == right.get_ylim()
    # Six fields and three kinds of line, not thirteen lines.
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 9
    shades = [handle.get_color() for handle in legend.legend_handles[:6]]
    assert len(set(shades)) == 6


def test_fields_on_both_sides_of_a_lens_share_their_entry_and_have_a_minus(triplet):
    fields = [(0.0, 0.0), (14.0, 0.0), (-14.0, 0.0)]
    frequencies = torch.linspace(0.0, 60.0, 11, dtype=torch.float64)
    figure = modulation_figure(modulation(triplet, fields, WAVES, frequencies, rays=200))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:2] == ["0°", "(14, 0)°, (−14, 0)°"]
    assert not flaws(figure)


@pytest.mark.parametrize("name", ["wavefront_coding", "freeform_corrector"])
def test_layouts(root, name):
    lens = load_lens(root / f"conf/lens/{name}.yaml").requires_grad_(False)
    assert not flaws(layout_figure(lens, fields_deg=(-2.0, 0.0, 2.0), rays=3, sensor=2.0))
    figure = before_after_figure(lens, lens, fields_deg=(-2.0, 0.0, 2.0), rays=3)
    assert not flaws(figure)
    above, below = figure.axes
    assert above.get_xlim() == below.get_xlim() and above.get_ylim() == below.get_ylim()


def test_the_damping_is_a_strip_below_the_merit():
    figure = history_figure([100.0 / 2**n for n in range(30)], [1e-3 / 2**n for n in range(30)])
    assert not flaws(figure)
    merit, damping = (axes.get_window_extent().height for axes in figure.axes)
    assert damping < 0.25 * merit


@pytest.mark.parametrize("spread", [1.0, 1.02])
def test_labels_of_alternatives_lie_apart(spread):
    """Eight alternatives of nearly one cost and error."""
    points = [Point(f"setting {n}", 1.0 + 0.01 * n, 2.0 - 0.01 * n * spread) for n in range(6)]
    figure = pareto_figure({"rays": points}, "time (s)", "error (µm)", "Title", 0.5)
    assert not flaws(figure)
    assert len(figure.axes[0].texts) == 6


def test_labels_keep_off_the_line_across_the_axes_and_off_lines_to_other_points():
    """Alternatives whose error is just above what the reference can tell."""
    floor = 1.0
    points = [Point(f"setting {n}", 1.0 + 0.02 * n, floor * 1.02) for n in range(5)]
    figure = pareto_figure({"rays": points}, "time (s)", "error (µm)", "Title", floor)
    assert not flaws(figure)
    (axes,) = figure.axes
    level = axes.transData.transform((1.0, floor))[1]
    boxes = {text: Text.get_window_extent(text) for text in axes.texts}
    assert not any(box.y0 < level < box.y1 for box in boxes.values())
    for text, box in boxes.items():
        if not text.arrow_patch.get_visible():
            continue
        start, end = axes.transData.transform(text.xy), 0.5 * (box.min + box.max)
        for share in np.linspace(0.0, 1.0, 100):
            x, y = start + share * (end - start)
            assert not any(
                other.x0 < x < other.x1 and other.y0 < y < other.y1
                for name, other in boxes.items()
                if name is not text
            )


def test_a_window_holds_nearly_all_light_of_every_function():
    """A cubic plate's triangles lie in one quadrant, and their windows about them."""
    psfs = torch.zeros(2, 3, 65, 65, dtype=torch.float64)
    psfs[0, :, 32:60, 32:60] = torch.ones(28, 28).triu().double()
    psfs[1, :, 30:50, 31:52] = 1.0
    top, left, side = window_of_light(psfs.sum(1))
    held = psfs[..., top : top + side, left : left + side].sum((1, 2, 3)) / psfs.sum((1, 2, 3))
    assert (held >= 0.99).all() and side <= 32
    figure = psf_figure(psfs, ["8 m", "4.5 m"], 0.0069, "Triangles")
    assert not flaws(figure)
    drawn = [axes.images[0].get_array() for axes in figure.axes]
    assert {picture.shape for picture in drawn} == {(side, side, 3)}


def test_a_scale_bar_is_as_long_as_it_says():
    psfs = torch.zeros(1, 3, 41, 41, dtype=torch.float64)
    psfs[0, :, 10:30, 10:30] = 1.0
    axes = psf_figure(psfs, ["8 m"], 0.00345).axes[0]
    (bar,) = (line for line in axes.get_lines() if line.get_gid() == "scale bar")
    (text,) = (text for text in axes.texts if text.get_gid() == "scale")
    pixels = float(np.ptp(bar.get_xdata())) * axes.images[0].get_array().shape[1]
    assert text.get_text().split(" µm")[0] == f"{pixels * 3.45:g}"


def test_pictures_of_a_camera():
    image = torch.rand(3, 24, 24)
    views = image.expand(3, 3, 24, 24)
    psnr = {"raw": [20.0] * 3, "restored": [25.0] * 3}
    figure = comparison_figure(image, views, views, ["8 m", "6 m", "4.5 m"], psnr, "Title\nbelow")
    assert not flaws(figure)


def test_images_of_sources_are_not_clipped():
    measured, initial = torch.zeros(2, 1, 40, 40)
    measured[0, 10:30, 12:28], initial[0, 14:26, 14:26] = 1.0, 3.0
    figure = spot_fit_figure(measured, initial, measured, ["10°"], 0.05, "Title")
    assert not flaws(figure)
    panels = [axes.images[0] for axes in figure.axes if axes.images][:3]
    assert {panel.norm.gamma for panel in panels} == {1.0}
    brightest = max(float(panel.get_array().max()) for panel in panels)
    assert [panel.get_clim()[1] for panel in panels] == pytest.approx([brightest] * 3)


def test_a_fit_of_many_variables():
    count = 30
    values = {f"source {n} z": ([1.0 / (k + n + 1) for k in range(count)], "mm") for n in range(9)}
    values["tilt"] = ([2.0 / (k + 1) for k in range(count)], "deg")
    losses = {"loss S21 (no unit)": [1.0 / (k + 1) for k in range(count)]}
    truth = dict.fromkeys(values, 0.0)
    figure = convergence_figure(losses, values, [("adam", 20), ("dls", 10)], truth, "Title")
    assert not flaws(figure)
    # Errors in mm, after the loss.
    lines = [line for line in figure.axes[1].get_lines() if line.get_label().startswith("source")]
    looks = {
        (line.get_color(), str(line.get_linestyle()), line._unscaled_dash_pattern) for line in lines
    }
    assert len(looks) == 9


def test_values_have_the_digits_that_their_deviations_allow():
    covariance = torch.diag(torch.tensor([3.3**2, 5.5e-3**2, 0.16**2]))
    centre = torch.tensor([-666.725, 119.45, 0.0])
    figure = corner_figure(covariance, ["z", "distance", "x"], ["mm", "mm", "deg"], centre)
    grid = np.array(figure.axes).reshape(3, 3)
    texts = [grid[n, n].texts[0].get_text() for n in range(3)]
    assert texts == ["z\n−667\n± 3 mm", "distance\n119.450\n± 0.005 mm", "x\n0.00\n± 0.16°"]
    assert not [flaw for flaw in flaws(figure) if "unit" not in flaw]


def test_tolerances():
    rows, names = (
        [f"(0, {n})°  588 nm" for n in range(6)],
        [f"tilt {n}  ± 0.05°" for n in range(9)],
    )
    matrix = torch.randn(6, 9)
    figure = matrix_figure({"motion (µm)": (matrix, names)}, rows, [("x", 3), ("y", 3)], "Title")
    assert not flaws(figure)
    radii = torch.linspace(0.01, 0.02, 100)
    panels = {"RMS radius": {"Monte Carlo": radii, "linear": radii * 1.01}}
    assert not flaws(yield_figure(panels, {"RMS radius": 0.011}, "Title"))
    bars = offenders_figure(names, [0.1] * 9, {"refocused": [1e-3] * 9, "not": [2e-3] * 9}, "Title")
    assert not flaws(bars)


def test_gain_against_light():
    lights = [30.0, 100.0, 1000.0]
    points = {"sweep, blind": {100.0: (0.2, -0.1, 0.4)}}
    found = GainRange("4.5 to 8 m", lights, {"sweep": [(0.1, 0.5)] * 3}, points)
    figure = coding_gain_figure([found, found])
    assert not flaws(figure)
    assert math.isfinite(drawn_points(figure.axes[0]).sum())


def test_light_around_a_focus_is_seen():
    """A disc of 1 % of the brightest pixel, a tenth up the colours by its root."""
    image = torch.zeros(1, 40, 40)
    image[0, 10:30, 10:30], image[0, 20, 20] = 0.01, 1.0
    figure = spot_fit_figure(image, image, image, ["0°"], 0.05, "Title")
    assert not flaws(figure)
    panel = next(axes.images[0] for axes in figure.axes if axes.images)
    assert float(panel.norm(0.01)) == pytest.approx(0.1)
    assert any("square-root scale" in axes.get_ylabel() for axes in figure.axes)
