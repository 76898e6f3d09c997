import math

import numpy as np
import pytest
import torch
from matplotlib.colors import same_color, to_rgb

from dolens.errors import InputError
from dolens.optics.elements import rotation_matrix
from dolens.optics.rays import Rays
from dolens.plotting import layout_figure
from dolens.plotting.section import surface_profile
from dolens.prescriptions import lens_from_prescription, load_lens

LENSES = [
    "asphere",
    "asphere_optimized",
    "cooke_triplet",
    "large_fov_doublet",
    "nikon",
    "nikon_optimized",
    "wavefront_coding",
]


@pytest.fixture
def lens(root):
    return lambda name: load_lens(root / "conf" / "lens" / f"{name}.yaml")


def drawn(figure, gid):
    return [np.stack(line.get_data(), -1) for line in lines(figure, gid)]


def lines(figure, gid):
    return [line for line in figure.axes[0].get_lines() if line.get_gid() == gid]


def glass(figure):
    return {patch.get_gid(): patch.get_path() for patch in figure.axes[0].patches}


def test_a_surface_that_clips_nothing_is_drawn_as_far_as_light_is_expected():
    row = {"type": "sphere", "radius": 40.0, "semi_diameter": 6.0, "clips": False}
    prescription = {
        "surfaces": {
            "1": {**row, "thickness": 3.0, "material": "1.5"},
            "2": {**row, "material": "air"},
        },
        "sensor": {"distance": 90.0},
    }
    z, y = surface_profile(lens_from_prescription(prescription).system(), 1)
    np.testing.assert_allclose(y[[0, -1]], [-6.0, 6.0], rtol=1e-12)
    assert z[-1] == pytest.approx(40.0 - math.sqrt(40.0**2 - 6.0**2), rel=1e-12)


@pytest.mark.parametrize("name", LENSES)
def test_every_lens_is_drawn_to_its_rims_with_its_rays(lens, name):
    one = lens(name)
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


def test_a_curve_is_the_sag_of_its_sphere(lens):
    curve = drawn(layout_figure(lens("cooke_triplet")), "surface 1")[0]
    radius = 22.014
    sag = radius - np.sqrt(radius**2 - curve[:, 1] ** 2)
    np.testing.assert_allclose(curve[:, 0], sag, atol=1e-12)


def test_the_sensor_is_where_and_as_high_as_the_prescription_says(lens):
    (sensor,) = drawn(layout_figure(lens("cooke_triplet")), "sensor")
    z = 3.259 + 6.008 + 1.000 + 4.750 + 2.952 + 42.208
    np.testing.assert_allclose(sensor, [[z, -36.346 / 2], [z, 36.346 / 2]])


def test_values_replace_stored_parameters(lens):
    one = lens("cooke_triplet")
    moved = layout_figure(one, values={"sensor_distance": torch.tensor(40.0).double()})
    (sensor,) = drawn(moved, "sensor")
    assert sensor[0, 0] == pytest.approx(57.969)
    assert all(path[-1, 0] == pytest.approx(57.969) for path in drawn(moved, "ray"))


def test_stop_bars_begin_at_the_rim_of_the_stop(lens):
    bars = drawn(layout_figure(lens("large_fov_doublet")), "stop")
    assert len(bars) == 2
    for bar, side in zip(bars, (1, -1), strict=True):
        assert bar[0, 1] == pytest.approx(side * 5.233)
        assert side * bar[1, 1] > 5.233 + 1.0
        np.testing.assert_allclose(bar[:, 0], 5.0 + 2.006 + 9.063)


@pytest.mark.parametrize("distance", [None, 500.0])
def test_drawn_rays_are_valid_rays_of_the_field(lens, distance):
    one = lens("cooke_triplet")
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


def test_the_outermost_axial_rays_graze_the_stop(lens):
    heights = [path[4, 1] for path in drawn(layout_figure(lens("cooke_triplet")), "ray")]
    assert max(heights) == pytest.approx(3.86, rel=0.01)
    assert min(heights) == pytest.approx(-3.86, rel=0.01)
    assert max(heights) < 3.86


def test_a_single_ray_is_the_chief_ray(lens):
    figure = layout_figure(lens("large_fov_doublet"), fields_deg=(5.0,), rays=1)
    (path,) = drawn(figure, "ray")
    assert abs(path[4, 1]) < 0.1  # through the stop's centre, but for aberrations of the pupil


def test_fields_have_colours_and_a_blocked_one_says_so(lens):
    figure = layout_figure(lens("cooke_triplet"), fields_deg=(0.0, 10.0, 75.0), rays=3)
    rays = lines(figure, "ray")
    assert len(rays) == 6
    assert not same_color(rays[0].get_color(), rays[3].get_color())
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["0°", "10°", "75° (no ray passes)"]


def test_only_glass_is_filled_and_cemented_elements_share_their_interface(lens):
    figure = layout_figure(lens("large_fov_doublet"))
    elements = glass(figure)
    assert set(elements) == {"glass 1", "glass 2"}
    assert len(drawn(figure, "surface 2")) == 1
    z_first, z_gap = 2.5, 11.0  # on the axis: within glass 1, and between surface 3 and the stop
    assert elements["glass 1"].contains_point((z_first, 0.0))
    assert not any(path.contains_point((z_gap, 0.0)) for path in elements.values())


def test_edges_close_unequal_rims_by_a_flat_and_a_cylinder(lens):
    figure = layout_figure(lens("nikon"))
    edge = drawn(figure, "edge")[0]
    front, back = (drawn(figure, f"surface {number}")[0] for number in (1, 2))
    np.testing.assert_allclose(edge, [front[-1], [back[-1, 0], front[-1, 1]], back[-1]])


def test_an_edge_does_not_cut_through_the_other_surface():
    ball = {
        "stop": 1,
        "surfaces": {
            "1": {"radius": 10.0, "semi_diameter": 4.0, "thickness": 2.0, "material": "1.5/60"},
            "2": {"radius": -10.0, "semi_diameter": 5.0, "material": "air"},
        },
        "sensor": {"distance": 10.0},
    }
    # The flat outside surface 1, at z = 0.83, would meet surface 2, which is at 0.66 on its rim.
    edge = drawn(layout_figure(lens_from_prescription(ball)), "edge")[0]
    assert edge.shape == (2, 2)


def test_a_plate_too_flat_to_see_has_its_sag_in_micrometres(lens):
    coefficient = torch.tensor(1.3e-5, dtype=torch.float64)
    values = {"surfaces.5.x3": coefficient, "surfaces.5.y3": 2 * coefficient}
    figure = layout_figure(lens("wavefront_coding"), values=values)
    assert len(figure.axes) == 2
    for line, factor in zip(figure.axes[1].get_lines(), (1, 2), strict=True):
        t, sag = line.get_data()
        np.testing.assert_allclose(sag, 1e3 * factor * 1.3e-5 * t**3, atol=1e-12)
        assert t[-1] == pytest.approx(6.35)
    assert len(layout_figure(lens("asphere")).axes) == 1


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


def test_the_lens_and_its_gradients_are_left_alone(lens):
    one = lens("wavefront_coding")
    before = [parameter.detach().clone() for parameter in one.parameters()]
    layout_figure(one)
    for parameter, old in zip(one.parameters(), before, strict=True):
        assert parameter.requires_grad and parameter.grad is None
        assert torch.equal(parameter, old)


def test_a_single_precision_lens_is_drawn_too(root):
    path = root / "conf" / "lens" / "nikon.yaml"
    assert len(drawn(layout_figure(load_lens(path, dtype=torch.float32), rays=4), "ray")) == 4


@pytest.mark.parametrize(
    "wrong",
    [{"rays": 0}, {"fields_deg": ()}, {"fields_deg": (90.0,)}, {"object_distance": -5.0}],
    ids=str,
)
def test_what_cannot_be_drawn_is_refused(lens, wrong):
    with pytest.raises(InputError, match="layout"):
        layout_figure(lens("asphere"), **wrong)


def test_several_wavelengths_colour_the_rays_from_blue_to_red(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    lines = [486.1327, 587.5618, 656.2725]
    figure = layout_figure(lens, lines, fields_deg=(0.0, 10.0), rays=3)
    axes = figure.axes[0]
    drawn = {line.get_color() for line in axes.lines if line.get_gid() == "ray"}
    assert len([line for line in axes.lines if line.get_gid() == "ray"]) == 3 * 2 * 3
    assert len(drawn) == 3
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["486.133 nm", "587.562 nm", "656.273 nm"]
    handles = axes.get_legend().legend_handles
    red_minus_blue = [to_rgb(h.get_color())[0] - to_rgb(h.get_color())[2] for h in handles]
    assert red_minus_blue == sorted(red_minus_blue)
    assert red_minus_blue[0] < 0.0 < red_minus_blue[-1]
    with pytest.raises(InputError, match="at least one wavelength"):
        layout_figure(lens, [])


def plane_and_sphere(**pose):
    """A plane of 8 mm and, 10 mm behind it, a sphere of R = 30 mm that an element carries."""
    return lens_from_prescription(
        {
            "surfaces": {
                "1": {"type": "plane", "semi_diameter": 8.0, "thickness": 10.0, "material": "air"},
                "2": {"radius": 30.0, "semi_diameter": 10.0, "material": "1.5168/64.17"},
            },
            "elements": {"1": {"surfaces": [2, 2], **pose}},
            "sensor": {"distance": 50.0},
        }
    )


@pytest.mark.parametrize(
    "tilts", [{"tilt_x": 30.0}, {"tilt_x": -12.0, "tilt_y": 15.0, "tilt_z": 70}]
)
def test_a_sphere_tilted_about_its_centre_is_cut_in_the_same_circle(tilts):
    """The plane x = 0 holds the centre, so every point of the cut is R from it in that plane."""
    system = plane_and_sphere(pivot=[0, 0, 30.0], **tilts).system()
    z, y = surface_profile(system, 2)
    assert np.allclose(np.hypot(z - 40.0, y), 30.0, rtol=1e-13)
    # The rim's great-circle angle from the tilted vertex is fixed: cos = √(1 - (10/30)²).
    r = rotation_matrix(
        *(torch.tensor(math.radians(tilts.get(k, 0.0))) for k in ("tilt_x", "tilt_y", "tilt_z"))
    ).double()
    vertex = torch.tensor([0.0, 0.0, -1.0]).double() @ r.T
    for end in (0, -1):
        towards = torch.tensor([0.0, y[end], z[end] - 40.0]).double() / 30.0
        assert float(towards @ vertex) == pytest.approx(math.sqrt(1.0 - 1.0 / 9.0), abs=1e-6)


def test_a_tilted_plane_is_drawn_to_its_rim():
    system = plane_and_sphere().system()
    tilted = lens_from_prescription(
        {
            "surfaces": {"1": {"type": "plane", "semi_diameter": 8.0, "material": "air"}},
            "elements": {
                "1": {"surfaces": [1, 1], "tilt_x": 30.0, "decenter_y": 1.0, "shift_z": 2.0}
            },
            "sensor": {"distance": 5.0},
        }
    ).system()
    assert surface_profile(system, 1)[1][-1] == pytest.approx(8.0, rel=1e-12)
    z, y = surface_profile(tilted, 1)
    # Right-handed about x: +y turns towards +z.
    half = math.radians(30.0)
    for end, side in ((-1, 1.0), (0, -1.0)):
        assert y[end] == pytest.approx(1.0 + side * 8.0 * math.cos(half), rel=1e-12)
        assert z[end] == pytest.approx(2.0 + side * 8.0 * math.sin(half), rel=1e-12)


def test_a_cut_beside_the_vertex_is_the_chord_it_meets():
    """Decentred by 6 mm in x, a disc of 10 mm is cut along a chord of half-length 8 mm."""
    z, y = surface_profile(plane_and_sphere(decenter_x=6.0).system(), 2)
    assert (y[0], y[-1]) == (pytest.approx(-8.0, rel=1e-12), pytest.approx(8.0, rel=1e-12))
    sag = 30.0 - math.sqrt(900.0 - 100.0)
    assert z[0] == pytest.approx(10.0 + sag, rel=1e-12)
    assert len(surface_profile(plane_and_sphere(decenter_x=11.0).system(), 2)[0]) == 0


def test_a_tilted_element_s_edges_run_along_its_own_axis():
    lens = lens_from_prescription(
        {
            "surfaces": {
                "1": {"radius": 30.0, "semi_diameter": 10.0, "thickness": 6.0,
                      "material": "1.5168/64.17"},
                "2": {"radius": -30.0, "semi_diameter": 10.0, "material": "air",
                      "obscuration": {"semi_diameter": 2.0}},
            },
            "elements": {"1": {"surfaces": [1, 2], "tilt_x": 20.0}},
            "sensor": {"distance": 30.0},
        }
    )  # fmt: skip
    axes = layout_figure(lens).axes[0]
    edges = [line.get_xydata() for line in axes.lines if line.get_gid() == "edge"]
    assert len(edges) == 2
    for edge in edges:
        dz, dy = edge[-1] - edge[0]
        # The axis of an element tilted by +θx leans towards -y.
        assert math.degrees(math.atan2(dy, dz)) == pytest.approx(-20.0, abs=1e-9)
    [blocked] = [line.get_xydata() for line in axes.lines if line.get_gid() == "obscuration"]
    assert np.linalg.norm(blocked[-1] - blocked[0]) == pytest.approx(4.0, rel=1e-12)


def obscured_window(**aperture):
    """A glass plate whose front has an aperture, 40 mm in front of the sensor."""
    front = {"radius": 50.0, "thickness": 2.0, "material": "1.5168/64.17", **aperture}
    back = {"type": "plane", "semi_diameter": 12.0, "material": "air"}
    return lens_from_prescription({"surfaces": {"1": front, "2": back}, "sensor": {"distance": 40}})


@pytest.mark.parametrize(
    "obscuration, heights",
    [
        ({"inner_semi_diameter": 3.0, "semi_diameter": 4.0}, [(-4.0, -3.0), (3.0, 4.0)]),
        # One arm lies along +y, the two others pass x = 0 at the centre, under it.
        ({"width": 1.0, "arms": 3, "angle": 90.0}, [(-0.5 / math.cos(math.pi / 6), 10.0)]),
        (
            [{"semi_diameter": 2.0}, {"half_width_x": 1.0, "half_width_y": 0.5, "decenter_y": 6.0}],
            [(-2.0, 2.0), (5.5, 6.5)],
        ),
        ({"polygons": [[[-1.0, -3.0], [1.0, -3.0], [0.0, -1.0]]]}, [(-3.0, -1.0)]),
    ],
)
def test_the_section_shows_what_blocks_light_in_its_plane(obscuration, heights):
    lens = obscured_window(semi_diameter=10.0, obscuration=obscuration)
    axes = layout_figure(lens).axes[0]
    blocked = [line.get_xydata() for line in axes.lines if line.get_gid() == "obscuration"]
    found = sorted((line[:, 1].min(), line[:, 1].max()) for line in blocked)
    np.testing.assert_allclose(found, heights, atol=1e-6)
    for line in blocked:
        sag = 50.0 - np.sqrt(2500.0 - line[:, 1] ** 2)
        np.testing.assert_allclose(line[:, 0], sag, atol=1e-9)


def test_a_polygon_s_section_reaches_from_its_lowest_side_to_its_highest():
    lens = obscured_window(aperture={"polygons": [[[-8.0, -3.0], [8.0, -3.0], [0.0, 7.0]]]})
    _, y = surface_profile(lens.system(), 1)
    assert (y.min(), y.max()) == pytest.approx((-3.0, 7.0), abs=1e-6)
