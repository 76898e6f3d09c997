"""The view in space shows apertures where they are."""

import math

import numpy as np
import pytest

from dolens.analysis.conditions import conditions
from dolens.lens_page.solid import blocked_sheets, edge_points, solid
from dolens.optics.surfaces.outlines import Polygons
from dolens.prescriptions import lens_from_prescription


def test_the_view_in_space_covers_what_is_blocked():
    """The areas of the meshes are those of the figures; a flat surface has no others."""
    obscuration = [
        {"inner_semi_diameter": 3.0, "semi_diameter": 4.0},
        {"width": 0.5, "arms": 2},
        {"polygons": [[[-2.0, 5.0], [2.0, 5.0], [2.0, 8.0], [0.0, 6.0], [-2.0, 8.0]]]},
    ]
    front = {"type": "plane", "semi_diameter": 10.0, "thickness": 2.0, "material": "1.5168/64.17"}
    back = {"type": "plane", "semi_diameter": 12.0, "material": "air"}
    surfaces = {"1": {**front, "obscuration": obscuration}, "2": back}
    lens = lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 40}})
    aperture = lens.surfaces["1"].aperture
    areas = []
    for points, closed in blocked_sheets(aperture):
        grid = np.concatenate([points, points[:, :1]], 1) if closed else points
        a, b = grid[1:, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, 1:]
        areas.append(abs(0.5 * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])).sum())
    # 64 azimuths of a circle have the area of a polygon.
    ring = math.pi * 7.0 * math.sin(2.0 * math.pi / 64) / (2.0 * math.pi / 64)
    assert areas[0] == pytest.approx(ring, rel=1e-12)
    assert areas[1:3] == pytest.approx([5.0, 5.0], rel=1e-12)
    assert sum(areas[3:]) == pytest.approx(8.0, rel=1e-12)
    meshes = solid(lens, conditions(lens)).meshes
    assert sum(mesh.kind == "block" for mesh in meshes) == len(areas)


def test_a_surface_off_the_axis_is_drawn_there():
    mirror = {"type": "conic", "radius": -200.0, "conic": -1.0, "material": "mirror",
              "aperture": {"semi_axis_x": 5.0, "semi_axis_y": 4.0, "decenter_y": 30.0}}  # fmt: skip
    lens = lens_from_prescription({"surfaces": {"1": mirror}, "sensor": {"distance": -100.0}})
    [mesh] = [m for m in solid(lens, conditions(lens), [False]).meshes if m.kind == "mirror"]
    y = mesh.positions[..., 1]
    assert (y.min(), y.max()) == pytest.approx((26.0, 34.0), abs=1e-5)
    assert mesh.positions[..., 2] == pytest.approx(
        -(mesh.positions[..., 0] ** 2 + y**2) / 400.0, abs=1e-5
    )


def test_glass_of_a_polygonal_aperture_is_its_convex_hull():
    notched = Polygons((((3.0, 1.0), (7.0, 1.0), (7.0, 5.0), (5.0, 2.0), (3.0, 5.0)),))
    edge = edge_points(notched)
    assert edge.min(0) == pytest.approx([3.0, 1.0], abs=1e-9)
    assert edge[:, 0].max() == pytest.approx(7.0, abs=1e-9)
    assert edge[:, 1].max() == pytest.approx(5.0, abs=0.05)
