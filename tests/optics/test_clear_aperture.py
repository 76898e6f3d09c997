"""What of a surface light passes, from the definitions of its outlines."""

import math

import pytest
import torch
from matplotlib.path import Path as Outline

from dolens import InputError, Rays, Status, load_lens
from dolens.diffraction.wavefront import coverage
from dolens.optics.thermal_lens import lens_at
from dolens.prescriptions import lens_from_prescription, prescription_of

pytestmark = pytest.mark.usefixtures("backend")
F64 = torch.float64
HEXAGON = [[2.0 * math.cos(k * math.pi / 3), 2.0 * math.sin(k * math.pi / 3)] for k in range(6)]
# A star whose corners point in and out, and a window of its own beside it.
STAR = [
    [r * math.cos(k * math.pi / 5), r * math.sin(k * math.pi / 5)]
    for k, r in enumerate([4.0, 1.5] * 5)
]
BESIDE = [[4.5, -1.0], [5.5, -1.0], [5.0, 1.0]]


def window(**aperture):
    """A plane that does nothing but clip."""
    return {
        "surfaces": {"1": {"type": "plane", "material": "air", **aperture}},
        "sensor": {"distance": 1.0},
    }


def passes(prescription, points, dtype=F64):
    lens = lens_from_prescription(prescription).to(dtype)
    points = torch.as_tensor(points, dtype=dtype)
    position = torch.cat([points, -torch.ones_like(points[:, :1])], 1)
    hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=dtype)))
    assert torch.equal(hit.valid, hit.status == Status.OK)
    assert set(hit.status.tolist()) <= {Status.OK, Status.VIGNETTED}
    return hit.valid


def cloud(count=4000, reach=6.0):
    generator = torch.Generator().manual_seed(3)
    return (2.0 * torch.rand(count, 2, generator=generator, dtype=F64) - 1.0) * reach


@pytest.fixture(params=[F64, torch.float32], ids=["f64", "f32"])
def dtype(request):
    return request.param


def test_polygons_pass_what_is_inside_any_of_them(dtype):
    points = cloud()
    inside = torch.zeros(len(points), dtype=torch.bool)
    for polygon in (STAR, BESIDE):
        inside |= torch.from_numpy(Outline([*polygon, polygon[0]]).contains_points(points))
    found = passes(window(aperture={"polygons": [STAR, BESIDE]}), points, dtype)
    assert torch.equal(found, inside)
    blocked = window(semi_diameter=8.5, obscuration={"polygons": [STAR, BESIDE]})
    assert torch.equal(passes(blocked, points, dtype), ~inside)


def test_a_polygon_in_another_is_a_hole():
    frame = [[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]]
    hole = [[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]]
    found = passes(
        window(aperture={"polygons": [frame, hole]}),
        [(0.0, 0.0), (2.0, 0.0), (0.0, -2.5), (4.0, 0.0)],
    )
    assert found.tolist() == [False, True, True, False]


@pytest.mark.parametrize("blocks", [False, True])
def test_sides_and_corners_stop_light_and_no_corner_counts_twice(blocks, dtype):
    square = [[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]
    diamond = [[0.0, -2.0], [2.0, 0.0], [0.0, 2.0], [-2.0, 0.0]]
    on = [(2.0, 0.0), (-2.0, 1.0), (0.0, 2.0), (1.0, -2.0), (2.0, 2.0), (-2.0, -2.0)]
    # At the height of the diamond's corners, and on its sides.
    beside = [(-3.0, 0.0), (3.0, 0.0), (-3.0, 2.0), (-3.0, -2.0)]
    edge = [(1.0, 1.0), (-0.5, 1.5), (0.0, 2.0), (2.0, 0.0)]
    how = {"semi_diameter": 9.0} if blocks else {}
    key = "obscuration" if blocks else "aperture"
    for polygon, points in ((square, on), (diamond, edge)):
        lens = window(**how, **{key: {"polygons": [polygon]}})
        assert not passes(lens, points, dtype).any()
    lens = window(**how, **{key: {"polygons": [diamond]}})
    assert bool((passes(lens, beside, dtype) == blocks).all())
    assert bool(passes(lens, [(0.0, 0.0)], dtype)) != blocks


def test_a_ring_blocks_between_its_circles_and_on_them(dtype):
    ring = window(
        semi_diameter=9.0,
        obscuration={"inner_semi_diameter": 2.0, "semi_diameter": 3.0, "decenter_y": 1.0},
    )
    points = [(0.0, 1.0), (1.75, 1.0), (2.0, 1.0), (0.0, 3.5), (0.0, 4.0), (0.0, 4.25)]
    expected = [True, True, False, False, False, True]
    assert passes(ring, points, dtype).tolist() == expected


def test_a_spider_s_arms_have_their_width_and_angles():
    points = cloud()
    angle = torch.atan2(points[:, 1], points[:, 0])
    radius = points.norm(dim=-1)
    blocked = torch.zeros_like(radius, dtype=torch.bool)
    for arm in (20.0, 140.0, 260.0):
        turn = angle - math.radians(arm)
        blocked |= (radius * torch.cos(turn) > 0.0) & ((radius * torch.sin(turn)).abs() < 0.4)
    spider = {"width": 0.8, "arms": 3, "angle": 20.0}
    found = passes(window(semi_diameter=20.0, obscuration=spider), points, F64)
    assert torch.equal(found, ~blocked)
    # On an arm's side, and at its middle.
    cross = window(semi_diameter=20.0, obscuration={"width": 1.0, "arms": 4})
    on = [(3.0, 0.5), (0.5, -4.0), (0.0, 0.0), (3.0, 0.75), (-0.75, -3.0)]
    assert passes(cross, on, F64).tolist() == [False] * 3 + [True] * 2


def test_several_obscurations_block_each_about_its_own_centre():
    lens = window(
        aperture={"half_width_x": 9.0, "half_width_y": 9.0, "decenter_x": 1.0},
        obscuration=[
            {"semi_diameter": 1.0},
            {"half_width_x": 2.0, "half_width_y": 0.5, "decenter_y": 4.0},
            {"semi_axis_x": 0.5, "semi_axis_y": 2.0, "decenter_x": -4.0},
        ],
    )
    points = [(0.0, 0.0), (1.5, 4.0), (-4.0, 1.5), (0.0, 2.0), (-4.0, 4.0), (1.0, 0.5)]
    expected = [False, False, False, True, True, True]
    assert passes(lens, points).tolist() == expected


def test_a_prescription_is_read_as_it_is_written():
    rows = [
        {"aperture": {"polygons": [HEXAGON, [[0.5, 0.0], [0.0, 0.5], [-0.5, -0.5]]]}},
        {"semi_diameter": 5.0, "obscuration": {"width": 0.5, "arms": 3, "angle": 30.0}},
        {"aperture": {"half_width_x": 3.0, "half_width_y": 2.0},
         "obscuration": {"semi_diameter": 0.5}},
        {"aperture": {"semi_axis_x": 3.0, "semi_axis_y": 4.0, "decenter_y": 1.0},
         "obscuration": [{"semi_diameter": 1.0}, {"width": 0.1, "arms": 4, "decenter_y": 1.0}]},
        {"aperture": {"half_width_x": 3.0, "half_width_y": 4.0, "decenter_y": 1.0},
         "obscuration": [{"inner_semi_diameter": 1.0, "semi_diameter": 2.0}]},
    ]  # fmt: skip
    single = window(semi_diameter=5.0, obscuration=[{"semi_diameter": 1.0, "decenter_x": 2.0}])
    plain = window(semi_diameter=5.0, obscuration={"semi_diameter": 1.0, "decenter_x": 2.0})
    first, second = (lens_from_prescription(data).surfaces["1"] for data in (single, plain))
    assert first.aperture == second.aperture
    # Centres are kept as differences: 0.1 - 0.3 + 0.3 is not 0.1.
    aside = {"half_width_x": 3.0, "half_width_y": 4.0, "decenter_x": 0.3}
    hole = {"semi_diameter": 1.0, "decenter_x": 0.1}
    lens = lens_from_prescription(window(aperture=aside, obscuration=hole))
    again = lens_from_prescription(prescription_of(lens))
    assert again.surfaces["1"].aperture == lens.surfaces["1"].aperture
    for written in rows:
        row = prescription_of(lens_from_prescription(window(**written)))["surfaces"]["1"]
        assert {key: row.get(key) for key in written} == written
        assert ("semi_diameter" in row) == ("semi_diameter" in written)


def test_figures_expand_with_their_surface():
    """N-BK7, 7.1e-6/K, 100 K warmer: every length grows by the same share."""
    figures = [{"polygons": [HEXAGON]}, {"width": 0.2, "arms": 3, "decenter_x": 3.0},
               {"inner_semi_diameter": 3.0, "semi_diameter": 3.5}]  # fmt: skip
    lens = lens_from_prescription(
        {
            "surfaces": {
                "1": {"type": "sphere", "radius": 50.0, "semi_diameter": 9.0, "thickness": 2.0,
                      "material": "SCHOTT:N-BK7", "obscuration": figures},
                "2": {"type": "sphere", "radius": -50.0, "semi_diameter": 9.0, "material": "air"},
            },
            "sensor": {"distance": 50.0},
        }
    )  # fmt: skip
    hot = lens_at(lens, 120.0)
    grown = float(lens.surfaces["1"].curvature.detach() / hot.surfaces["1"].curvature.detach())
    assert grown == pytest.approx(1.0 + 100.0 * 7.1e-6, abs=5e-5)
    (hexagon, _), (spider, center), (ring, _) = hot.surfaces["1"].aperture.obscuration.parts
    assert hexagon.semi_diameter == pytest.approx(2.0 * grown, rel=1e-12)
    assert (spider.width, center[0]) == pytest.approx((0.2 * grown, 3.0 * grown), rel=1e-12)
    assert ring.inner_semi_diameter == pytest.approx(3.0 * grown, rel=1e-12)


def test_arms_narrower_than_a_pupil_s_cells_keep_their_area():
    """A cross of width w in a disc of radius 1 takes 4·w - w², but for its rounded ends."""
    axis = (torch.arange(40, dtype=F64) + 0.5) * 0.06 - 1.2 + 0.013
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    for width in (0.01, 0.05, 0.2):
        row = {"semi_diameter": 1.0, "obscuration": {"width": width, "arms": 4}}
        lens = lens_from_prescription(window(**row))
        area = float(coverage(lens.surfaces["1"].aperture, x, y).sum()) * 0.06**2
        taken = 4.0 * width - width**2 - 4.0 * width**3 / 24.0
        assert math.pi - area == pytest.approx(taken, rel=0.02, abs=4e-4)


def test_a_rectangle_passes_what_lies_strictly_inside_its_sides():
    rectangle = window(aperture={"half_width_x": 3.0, "half_width_y": 2.0})
    points = [(2.9, 1.9), (-2.9, -1.9), (3.0, 0.0), (0.0, 2.0), (3.1, 0.0), (0.0, -2.1)]
    assert passes(rectangle, points).tolist() == [True, True, False, False, False, False]


def test_an_obscuration_blocks_the_middle_and_its_own_edge():
    annulus = window(semi_diameter=5.0, obscuration={"semi_diameter": 2.0})
    points = [(0.0, 0.0), (0.0, 1.9), (2.0, 0.0), (0.0, 2.1), (4.9, 0.0), (5.0, 0.0)]
    assert passes(annulus, points).tolist() == [False, False, False, True, True, False]
    square = window(semi_diameter=5.0, obscuration={"half_width_x": 1.0, "half_width_y": 2.0})
    found = passes(square, [(0.9, 1.9), (1.1, 0.0), (0.0, 2.1)])
    assert found.tolist() == [False, True, True]


@pytest.mark.parametrize(
    "aperture, message",
    [
        ({}, "surface 1: 'semi_diameter' is missing"),
        ({"semi_diameter": 1.0, "aperture": {"half_width_x": 1}}, "'half_width_y' is missing"),
        ({"semi_diameter": 1.0, "clips": 0}, "'clips' must be true or false, not 0"),
        ({"semi_diameter": "auto", "clips": True}, "an automatic semi-diameter clips nothing"),
        ({"clips": False, "aperture": {"semi_diameter": 1}}, "'aperture' clips"),
        ({"aperture": {"semi_diameter": 1, "semi_axis_x": 1}}, "give one of semi_diameter, half"),
        ({"aperture": {"semi_axis_x": 1.0}}, "'semi_axis_y' is missing"),
        ({"aperture": {"half_width_x": 1.0}}, "'half_width_y' is missing"),
        (
            {"aperture": {"half_width_x": 1.0, "half_width_y": -1.0}},
            "half_width_y must be positive",
        ),
        ({"aperture": {"width": 1.0}}, "unknown key 'width'"),
        ({"semi_diameter": 0.0}, "semi_diameter must be positive"),
        ({"semi_diameter": 1.0, "obscuration": {"semi_diameter": 2.0}}, "obscuration reaches 2 mm"),
        ({"aperture": {"polygons": [[[0, 0], [1, 0]]]}}, "at least three vertices"),
        ({"aperture": {"polygons": [[0, 1], [1, 0]]}}, "'polygons': must be a list of lists"),
        ({"aperture": {"polygons": []}}, "'polygons': must be a list of lists"),
        ({"aperture": {"width": 1.0, "arms": 3}}, "unknown key 'width'"),
        ({"semi_diameter": 3.0, "obscuration": []}, "'obscuration': is an empty list"),
        ({"semi_diameter": 3.0, "obscuration": {"width": 1.0}}, "'arms' is missing"),
        ({"semi_diameter": 3.0, "obscuration": {"width": 1.0, "arms": 2.5}}, "a whole number"),
        ({"semi_diameter": 3.0, "obscuration": {"width": 0.0, "arms": 2}}, "must be positive"),
        (
            {"semi_diameter": 3.0, "obscuration": {"inner_semi_diameter": 2, "semi_diameter": 1}},
            "must be below semi_diameter",
        ),
        (
            {"semi_diameter": 3.0, "obscuration": [{"semi_diameter": 1}, {"angle": 3.0}]},
            "'obscuration' 2: give one of",
        ),
    ],
)
def test_bad_apertures_are_one_clear_line(aperture, message):
    with pytest.raises(InputError, match=message):
        lens_from_prescription(window(**aperture))


def test_blades_make_a_regular_polygon():
    points, turn = cloud(), math.radians(20.0)
    corners = [
        [4.0 * math.cos(turn + k * 0.4 * math.pi), 4.0 * math.sin(turn + k * 0.4 * math.pi)]
        for k in range(5)
    ]
    given = window(aperture={"blades": 5, "semi_diameter": 4.0, "angle": 20.0})
    inside = torch.from_numpy(Outline([*corners, corners[0]]).contains_points(points))
    assert torch.equal(passes(given, points), inside)
    written = prescription_of(lens_from_prescription(given))["surfaces"]["1"]["aperture"]
    assert torch.equal(passes(window(aperture=written), points), inside)


def test_an_iris_has_its_corners_on_the_stop_s_circle():
    lens = load_lens("cooke_triplet").with_iris(6, f_number=8)
    stop = lens.surfaces[str(lens.stop)].aperture
    assert stop.window.semi_diameter == pytest.approx(stop.edge.semi_diameter, rel=1e-12)
    assert float(lens.first_order(550).f_number) == pytest.approx(8.0, rel=3e-3)
    with pytest.raises(InputError, match="an iris needs a stop whose edge is a circle"):
        lens.with_iris(6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"blades": 2, "semi_diameter": 4}, "'blades' must be a whole number from 3 to 100, not 2"),
        ({"blades": 5}, "'aperture': 'semi_diameter' is missing"),
        ({"semi_diameter": 4, "half_width_x": 4}, "'aperture': give one of semi_diameter, half"),
    ],
)
def test_what_is_no_iris_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        lens_from_prescription(window(aperture=given))
