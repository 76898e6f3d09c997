"""What a layout shows is what the lens does."""

import json
import math
import re

import numpy as np
import pytest
import torch
from matplotlib.colors import same_color, to_rgb

from dolens import load_lens
from dolens.errors import InputError
from dolens.lens_page.page import write_page
from dolens.manufacturing.glass_elements import glass_elements
from dolens.optics.rays import Rays
from dolens.plotting import (
    layout_figure,
)
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.exit_pupil import axial_exit_pupil
from tests.optics.test_coordinate_breaks import newtonian
from tests.plotting.artists import by_gid, drawn, legend
from tests.plotting.overlaps import flaws

LENSES = [
    "asphere",
    "asphere_optimized",
    "cooke_triplet",
    "large_fov_doublet",
    "nikon",
    "nikon_optimized",
    "wavefront_coding",
]


@pytest.mark.parametrize("name", LENSES)
def test_every_lens_is_drawn_to_its_rims_with_its_rays(name):
    one = load_lens(name)
    figure = layout_figure(one, rays=5)
    system = one.system()
    for number, surface in enumerate(system.surfaces, 1):
        curves = drawn(figure, f"surface {number}")
        assert len(curves) == (surface.shape.kind != "aperture")
        for curve in curves:
            height = surface.semi_diameter
            np.testing.assert_allclose(curve[[0, -1], 1], [-height, height], rtol=1e-12)
            middle = float(system.vertices[number - 1].detach())
            assert curve[len(curve) // 2, 0] == pytest.approx(middle, abs=1e-12)
    assert len(drawn(figure, "ray")) == 5
    x_limits, y_limits = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    for line in figure.axes[0].get_lines():
        z, y = line.get_data()
        assert x_limits[0] <= min(z) and max(z) <= x_limits[1]
        assert y_limits[0] <= min(y) and max(y) <= y_limits[1]
    assert figure.axes[0].get_aspect() == 1.0


def test_a_curve_is_the_sag_of_its_sphere():
    curve = drawn(layout_figure(load_lens("cooke_triplet")), "surface 1")[0]
    radius = 22.014
    sag = radius - np.sqrt(radius**2 - curve[:, 1] ** 2)
    np.testing.assert_allclose(curve[:, 0], sag, atol=1e-12)


def test_the_sensor_is_where_and_as_high_as_the_prescription_says():
    (sensor,) = drawn(layout_figure(load_lens("cooke_triplet")), "sensor")
    z = 3.259 + 6.008 + 1.000 + 4.750 + 2.952 + 42.208
    np.testing.assert_allclose(sensor, [[z, -36.346 / 2], [z, 36.346 / 2]])


def test_values_replace_stored_parameters():
    one = load_lens("cooke_triplet")
    moved = layout_figure(one.with_values({"sensor_distance": torch.tensor(40.0).double()}))
    (sensor,) = drawn(moved, "sensor")
    assert sensor[0, 0] == pytest.approx(57.969)
    assert all(path[-1, 0] == pytest.approx(57.969) for path in drawn(moved, "ray"))


def test_stop_bars_begin_at_the_rim_of_the_stop():
    bars = drawn(layout_figure(load_lens("large_fov_doublet")), "stop")
    assert len(bars) == 2
    for bar, side in zip(bars, (1, -1), strict=True):
        assert bar[0, 1] == pytest.approx(side * 5.233)
        assert side * bar[1, 1] > 5.233 + 1.0
        np.testing.assert_allclose(bar[:, 0], 5.0 + 2.006 + 9.063)


@pytest.mark.parametrize("distance", [None, 500.0])
def test_drawn_rays_are_valid_rays_of_the_field(distance):
    one = load_lens("cooke_triplet")
    figure = layout_figure(one, fields_deg=(12.0,), rays=6, object_distance=distance)
    paths = torch.as_tensor(np.stack(drawn(figure, "ray")))
    assert paths.shape == (6, 8, 2)
    step = paths[:, 1] - paths[:, 0]
    direction = torch.nn.functional.normalize(
        torch.stack([torch.zeros(6), step[:, 1], step[:, 0]], -1), dim=-1
    )
    position = torch.stack([torch.zeros(6), paths[:, 0, 1], paths[:, 0, 0]], -1)
    traced = one.trace(Rays(position, direction), record=True)
    assert traced.valid.all()
    expected = torch.cat([traced.points.transpose(0, 1), traced.position[:, None]], 1)
    torch.testing.assert_close(paths[:, 1:, 1], expected[..., 1], rtol=0, atol=1e-9)
    torch.testing.assert_close(paths[:, 1:, 0], expected[..., 2], rtol=0, atol=1e-9)
    slopes = step[:, 1] / step[:, 0]
    if distance is None:
        expected_slope = torch.full_like(slopes, math.tan(math.radians(12.0)))
        torch.testing.assert_close(slopes, expected_slope)
    else:
        pupil = float(one.first_order().entrance_pupil.z.detach())
        height = -(distance + pupil) * math.tan(math.radians(12.0))
        at_object = paths[:, 0, 1] + slopes * (-distance - paths[:, 0, 0])
        torch.testing.assert_close(at_object, torch.full_like(slopes, height))


def test_the_outermost_axial_rays_graze_the_stop():
    heights = [path[4, 1] for path in drawn(layout_figure(load_lens("cooke_triplet")), "ray")]
    assert max(heights) == pytest.approx(3.86, rel=0.01)
    assert min(heights) == pytest.approx(-3.86, rel=0.01)
    assert max(heights) < 3.86


def test_a_single_ray_is_the_chief_ray():
    figure = layout_figure(load_lens("large_fov_doublet"), fields_deg=(5.0,), rays=1)
    (path,) = drawn(figure, "ray")
    assert abs(path[4, 1]) < 0.1  # through the stop's centre, but for aberrations of the pupil


def test_fields_have_colours_and_a_blocked_one_says_so():
    figure = layout_figure(load_lens("cooke_triplet"), fields_deg=(0.0, 10.0, 75.0), rays=3)
    rays = by_gid(figure.axes[0], "ray")
    assert len(rays) == 6
    assert not same_color(rays[0].get_color(), rays[3].get_color())
    assert legend(figure) == ["0°", "10°", "75° (no ray passes)"]


def test_only_glass_is_filled_and_cemented_elements_share_their_interface():
    figure = layout_figure(load_lens("large_fov_doublet"))
    elements = {patch.get_gid(): patch.get_path() for patch in figure.axes[0].patches}
    assert set(elements) == {"glass 1", "glass 2"}
    assert len(drawn(figure, "surface 2")) == 1
    z_first, z_gap = 2.5, 11.0  # on the axis: within glass 1, and between surface 3 and the stop
    assert elements["glass 1"].contains_point((z_first, 0.0))
    assert not any(path.contains_point((z_gap, 0.0)) for path in elements.values())


def test_a_plate_too_flat_to_see_has_its_sag_in_micrometres():
    coefficient = torch.tensor(1.3e-5, dtype=torch.float64)
    values = {"surfaces.5.x3": coefficient, "surfaces.5.y3": 2 * coefficient}
    figure = layout_figure(load_lens("wavefront_coding").with_values(values))
    assert len(figure.axes) == 2
    for line, factor in zip(figure.axes[1].get_lines(), (1, 2), strict=True):
        t, sag = line.get_data()
        np.testing.assert_allclose(sag, 1e3 * factor * 1.3e-5 * t**3, atol=1e-12)
        assert t[-1] == pytest.approx(6.35)
    # None of a plate without sag, nor of a lens without a plate.
    flat = dict.fromkeys(values, torch.zeros_like(coefficient))
    plain = load_lens("wavefront_coding").with_values(flat)
    assert len(layout_figure(plain).axes) == 1
    assert len(layout_figure(load_lens("asphere")).axes) == 1


def test_a_flat_spline_plate_has_its_sag_in_micrometres():
    """1 µm of tilt across 10 mm."""
    tilt = [[1e-3 * i / 3 for i in range(4)]] * 4
    plate = {
        "surfaces": {
            "1": {"type": "b_spline", "coefficients": tilt, "half_width": 5, "semi_diameter": 5,
                  "thickness": 2.0, "material": "1.5/60"},
            "2": {"type": "sphere", "radius": -30.0, "semi_diameter": 5, "material": "air"},
        },
        "sensor": {"distance": 60.0},
    }  # fmt: skip
    figure = layout_figure(lens_from_prescription(plate, torch.float32))
    (along_x, _) = figure.axes[1].get_lines()
    t, sag = along_x.get_data()
    np.testing.assert_allclose(sag, 0.5 + 0.1 * t, atol=1e-6)
    assert t[0] == pytest.approx(-5.0)
    assert t[-1] == pytest.approx(5.0)


def test_the_lens_and_its_gradients_are_left_alone():
    one = load_lens("wavefront_coding")
    before = [parameter.detach().clone() for parameter in one.parameters()]
    layout_figure(one)
    for parameter, old in zip(one.parameters(), before, strict=True):
        assert parameter.requires_grad and parameter.grad is None
        assert torch.equal(parameter, old)


def test_a_single_precision_lens_is_drawn_too():
    lens = load_lens("nikon", dtype=torch.float32)
    assert len(drawn(layout_figure(lens, rays=4), "ray")) == 4


@pytest.mark.parametrize(
    "wrong",
    [{"rays": 0}, {"fields_deg": ()}, {"fields_deg": (90.0,)}, {"object_distance": -5.0}],
    ids=str,
)
def test_what_cannot_be_drawn_is_refused(wrong):
    with pytest.raises(InputError, match="layout"):
        layout_figure(load_lens("asphere"), **wrong)


def test_several_wavelengths_colour_the_rays_from_blue_to_red():
    lens = load_lens("cooke_triplet")
    lines = [486.1327, 587.5618, 656.2725]
    figure = layout_figure(lens, lines, fields_deg=(0.0, 10.0), rays=3)
    axes = figure.axes[0]
    rays = by_gid(axes, "ray")
    assert len(rays) == 3 * 2 * 3 and len({line.get_color() for line in rays}) == 3
    assert legend(figure) == ["486.133 nm", "587.562 nm", "656.273 nm"]
    handles = axes.get_legend().legend_handles
    red_minus_blue = [to_rgb(h.get_color())[0] - to_rgb(h.get_color())[2] for h in handles]
    assert red_minus_blue == sorted(red_minus_blue)
    assert red_minus_blue[0] < 0.0 < red_minus_blue[-1]
    with pytest.raises(InputError, match="at least one wavelength"):
        layout_figure(lens, [])


def test_no_label_is_cut_at_the_edge():
    """A plate of some picometres, whose sags have long numbers."""
    lens = load_lens("wavefront_coding").requires_grad_(False)
    lens.surfaces["5"].x3.fill_(1e-11)
    assert not flaws(layout_figure(lens, fields_deg=(0.0, 0.5), rays=3))
    figure = layout_figure(lens, fields_deg=(-2.0, 0.0, 2.0), rays=3, sensor=2.0)
    assert not flaws(figure)


@pytest.fixture(scope="module")
def telescope():
    lens = newtonian()
    lens.name = "Newtonian"
    return lens


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


def test_what_needs_a_straight_axis_says_so(telescope):
    with pytest.raises(InputError, match="rendering: surface 1 is a mirror"):
        axial_exit_pupil(telescope.system(), [550.0])
    with pytest.raises(InputError, match="drawings and solids: surface 1 is a mirror"):
        glass_elements(telescope)
