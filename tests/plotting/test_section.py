"""How the plane of a section cuts surfaces: their profiles, rims and obscurations."""

import math

import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.optics.elements import rotation_matrix
from dolens.plotting import layout_figure
from dolens.plotting.section import surface_profile
from dolens.prescriptions import lens_from_prescription
from tests.plotting.artists import by_gid, drawn


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


def test_edges_close_unequal_rims_by_a_flat_and_a_cylinder():
    figure = layout_figure(load_lens("nikon"))
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
    edges = [line.get_xydata() for line in by_gid(axes, "edge")]
    assert len(edges) == 2
    for edge in edges:
        dz, dy = edge[-1] - edge[0]
        # The axis of an element tilted by +θx leans towards -y.
        assert math.degrees(math.atan2(dy, dz)) == pytest.approx(-20.0, abs=1e-9)
    [blocked] = [line.get_xydata() for line in by_gid(axes, "obscuration")]
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
    blocked = drawn(layout_figure(lens), "obscuration")
    found = sorted((line[:, 1].min(), line[:, 1].max()) for line in blocked)
    np.testing.assert_allclose(found, heights, atol=1e-6)
    for line in blocked:
        sag = 50.0 - np.sqrt(2500.0 - line[:, 1] ** 2)
        np.testing.assert_allclose(line[:, 0], sag, atol=1e-9)


def test_a_polygon_s_section_reaches_from_its_lowest_side_to_its_highest():
    lens = obscured_window(aperture={"polygons": [[[-8.0, -3.0], [8.0, -3.0], [0.0, 7.0]]]})
    _, y = surface_profile(lens.system(), 1)
    assert (y.min(), y.max()) == pytest.approx((-3.0, 7.0), abs=1e-6)
