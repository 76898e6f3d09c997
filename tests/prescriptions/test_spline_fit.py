"""Fits of B-spline surfaces to sag data, and what a prescription makes of them."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline as SciPySpline

from dolens import InputError, load_lens, save_lens
from dolens.optics.surfaces.b_spline import clamped_knots
from dolens.prescriptions import fit_b_spline, lens_from_prescription, prescription_of
from tests.refused import refused

KNOTS_X = clamped_knots(5.0, 12)
# Uneven, with a crease.
KNOTS_Y = [-6.0, -5.5, -5.2, -4.0, -1.0, 0.0, 0.0, 0.0, 2.5, 4.0, 4.0, 4.5, 7.0]


def spline(coefficients, x, y, knots_x=KNOTS_X, knots_y=KNOTS_Y):
    """Sag at scattered points, by SciPy's one-dimensional splines."""
    rows = SciPySpline(np.array(knots_y), np.eye(len(knots_y) - 4), 3)(y)
    columns = SciPySpline(np.array(knots_x), np.eye(len(knots_x) - 4), 3)(x)
    return np.einsum("pj,ji,pi->p", rows, np.asarray(coefficients), columns)


def sphere(x, y, radius=50.0):
    r2 = x**2 + y**2
    return r2 / (radius + np.sqrt(radius**2 - r2))


@pytest.mark.parametrize("gridded", [False, True], ids=["scattered", "gridded"])
def test_a_spline_s_own_coefficients_come_back(gridded):
    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=(9, 12))
    if gridded:
        x, y = np.linspace(-5, 5, 60), np.linspace(-4, 4, 50)
        sag = spline(coefficients, *(v.ravel() for v in np.meshgrid(x, y))).reshape(50, 60)
    else:
        x, y = rng.uniform(-5, 5, 4000), rng.uniform(-4, 4, 4000)
        sag = spline(coefficients, x, y)
    row = fit_b_spline(x, y, sag, KNOTS_X, KNOTS_Y)
    assert row.keys() == {"type", "coefficients", "knots_x", "knots_y"}
    assert (row["type"], row["knots_x"], row["knots_y"]) == ("b_spline", KNOTS_X, KNOTS_Y)
    assert np.abs(np.array(row["coefficients"]) - coefficients).max() < 1e-10


def test_the_fit_is_the_least_squares_one():
    """Noise has no part along the basis left: the residual is orthogonal to every column."""
    rng = np.random.default_rng(2)
    x, y, sag = rng.uniform(-5, 5, 900), rng.uniform(-4, 4, 900), rng.normal(size=900)
    row = fit_b_spline(x, y, sag, KNOTS_X, KNOTS_Y)
    residual = sag - spline(row["coefficients"], x, y)
    assert 0.8 < np.std(residual) < 1.0
    for j in range(9):
        for i in range(12):
            unit = np.zeros((9, 12))
            unit[j, i] = 1.0
            assert abs(residual @ spline(unit, x, y)) < 1e-12


def test_the_error_of_a_sphere_falls_as_h4():
    grid, errors = np.linspace(-5, 5, 160), []
    x, y = np.meshgrid(grid, grid)
    for spans in (4, 8, 16, 32):
        knots = clamped_knots(5.0, spans + 3)
        row = fit_b_spline(grid, grid, sphere(x, y), knots, knots)
        found = spline(row["coefficients"], x.ravel(), y.ravel(), knots, knots)
        errors.append(np.abs(found - sphere(x, y).ravel()).max())
    assert errors[-1] < 1e-9
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (np.abs(orders - 4.0) < 0.25).all()


def test_data_in_a_circle_leave_the_corners_to_smoothing():
    grid, knots = np.linspace(-5, 5, 101), clamped_knots(5.0, 13)
    x, y = np.meshgrid(grid, grid)
    disc = x**2 + y**2 < 25.0
    x, y = x[disc], y[disc]
    with pytest.raises(InputError, match=r"leave coefficients undetermined \(the first: row 1, co"):
        fit_b_spline(x, y, sphere(x, y), knots, knots)
    row = fit_b_spline(x, y, sphere(x, y), knots, knots, smoothing=1e-12)
    assert np.abs(spline(row["coefficients"], x, y, knots, knots) - sphere(x, y)).max() < 1e-7
    corner = spline(row["coefficients"], np.array([5.0]), np.array([-5.0]), knots, knots)
    assert corner == pytest.approx(sphere(5.0, 5.0), abs=0.05)


def test_much_smoothing_leaves_the_plane_of_best_fit():
    """Planes alone have no bending energy, whatever the knots."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-5, 5, 500), rng.uniform(-4, 4, 500)
    sag = 0.3 + 0.1 * x - 0.2 * y + 0.01 * rng.normal(size=500)
    # Without a crease, which a thin plate's energy does not see.
    knots_y = clamped_knots(4.0, 8)
    row = fit_b_spline(x, y, sag, KNOTS_X, knots_y, smoothing=1e6)
    columns = np.stack((np.ones(500), x, y), 1)
    plane = columns @ np.linalg.lstsq(columns, sag, rcond=None)[0]
    assert np.abs(spline(row["coefficients"], x, y, knots_y=knots_y) - plane).max() < 1e-6


def test_the_energy_is_the_integral():
    """One coefficient against s = x²·y: mean of s_xx² + 2·s_xy² + s_yy² = mean of 4y² + 8x²."""
    from dolens.optics.surfaces.spline_fit import _bending

    knots_x, knots_y = clamped_knots(3.0, 6), clamped_knots(2.0, 5)
    t, u = np.array(knots_x), np.array(knots_y)
    square = (t[1:-3] * t[2:-2] + t[2:-2] * t[3:-1] + t[3:-1] * t[1:-3]) / 3
    coefficients = np.outer((u[1:-3] + u[2:-2] + u[3:-1]) / 3, square)
    energy = ((_bending(u, t) @ coefficients.ravel()) ** 2).sum()
    assert energy == pytest.approx(4 * 2.0**2 / 3 + 8 * 3.0**2 / 3, rel=1e-13)


GRID = np.linspace(-5, 5, 21)
FLAT = np.zeros((21, 21))
SQUARE = clamped_knots(5.0, 6)
GAP = clamped_knots(5.0, 30)
NAN = np.where(np.arange(441).reshape(21, 21) < 3, math.nan, 0.0)
BAD = {
    "shapes": ((GRID, GRID, FLAT[:, :20], SQUARE, SQUARE), "not x (21,), y (21,), sag (21, 20)"),
    "nothing": (([], [], [], SQUARE, SQUARE), "sag data need x and y of the shape of sag"),
    "holes": ((GRID, GRID, NAN, SQUARE, SQUARE), "3 of 441 values of sag are not finite"),
    "beyond": ((GRID * 1.2, GRID, FLAT, SQUARE, SQUARE),
               "data reach from x = -6 to 6 mm, beyond the knots, which end at -5 and 5 mm"),
    "few knots": ((GRID, GRID, FLAT, SQUARE[:7], SQUARE), "'knots_x' must be one list of at least"),
    "bad knots": ((GRID, GRID, FLAT, SQUARE, SQUARE[::-1]), "'knots_y' must not decrease"),
    "empty spans": ((GRID, GRID, FLAT, SQUARE, GAP), "leave coefficients undetermined"),
    "half the square": ((GRID[:12], GRID, FLAT[:, :12], SQUARE, SQUARE),
                        "undetermined (the first: row 1, column 6)"),
    "on a line": ((GRID, 0 * GRID, 0 * GRID, clamped_knots(5.0, 4), SQUARE),
                  "leave coefficients undetermined"),
    "fewer data than coefficients": ((GRID[::4], GRID[::4], FLAT[::4, ::4], SQUARE, GAP),
                                     "leave coefficients undetermined"),
    "negative smoothing": ((GRID, GRID, FLAT, SQUARE, SQUARE, -1.0), "'smoothing' must be"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_data(case):
    given, said = BAD[case]
    with refused(said):
        fit_b_spline(*given)


def prescription(**front):
    front = {"type": "b_spline", "semi_diameter": 4.0, "thickness": 3.0,
             "material": "1.5168/64.17", **front}  # fmt: skip
    back = {"type": "sphere", "radius": -80.0, "semi_diameter": 4.0, "material": "air"}
    return {"surfaces": {"1": front, "2": back}, "sensor": {"distance": 60.0}}


def rows(seed=0, shape=(7, 9)):
    return np.random.default_rng(seed).normal(size=shape).tolist()


WIDTHS = {
    "half width": {"half_width": 4.3},
    "half widths": {"half_width_x": 4.3, "half_width_y": 5.1},
    "knots": {"knots_x": [-6.1, -5.0, -4.7, -4.2, -1, 0, 0, 0, 0.1, 4.1, 4.1, 4.2, 5],
              "half_width_y": 4.0},
}  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
@pytest.mark.parametrize("widths", WIDTHS)
def test_a_spline_comes_back_to_the_last_bit(widths, dtype, tmp_path):
    lens = lens_from_prescription(
        prescription(coefficients=rows(), **WIDTHS[widths]), dtype, where="here"
    )
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml", dtype)
    before, after = lens.surfaces["1"].state_dict(), again.surfaces["1"].state_dict()
    assert list(before) == ["coefficients", "knots_x", "knots_y"] == list(after)
    for name, value in before.items():
        assert value.dtype == dtype
        assert torch.equal(value, after[name])
    assert prescription_of(again)["surfaces"] == prescription_of(lens)["surfaces"]
    assert [name for name, _ in lens.named_parameters() if name.startswith("surfaces.1.")] == [
        "surfaces.1.coefficients"
    ]


def test_rows_of_coefficients_are_along_y():
    sag_is_y = [[y] * 4 for y in (-6.0, -2.0, 2.0, 6.0)]
    lens = lens_from_prescription(prescription(coefficients=sag_is_y, half_width=6.0))
    front = lens.surfaces["1"]
    p = {**dict(front.named_parameters()), **dict(front.named_buffers())}
    sag, sx, sy, _ = front.sag_and_gradient(p, torch.tensor(1.0), torch.tensor(2.5))
    assert float(sag.detach()) == pytest.approx(2.5, abs=1e-6)
    assert (float(sx.detach()), float(sy.detach())) == pytest.approx((0.0, 1.0), abs=1e-6)


BAD_ROWS = {
    "misspelt": ({"half_widht": 5.0}, "unknown key 'half_widht'; did you mean 'half_width'?"),
    "no knots": ({}, "give one of 'knots_x', 'half_width_x' and 'half_width' (mm), not none"),
    "no coefficients": ({"half_width": 5.0, "coefficients": None},
                        "'coefficients' must be a number, not None"),
    "a word in a row": ({"half_width": 5.0, "coefficients": [[0, 0, 0, "thin"]] * 4},
                        "'coefficients' must be a number, not 'thin'"),
    "infinite": ({"half_width": 5.0, "coefficients": [[0, 0, 0, math.inf]] * 4},
                 "'coefficients' must be a finite number, not inf"),
    "a list of widths": ({"half_width": [5.0, 6.0]},
                         "'half_width' must be a number, not [5.0, 6.0]"),
    "a radius": ({"half_width": 5.0, "radius": 20.0}, "of type 'b_spline' has no 'radius'"),
    "a curvature": ({"half_width": 5.0, "curvature": 0.1}, "unknown key 'curvature'"),
    "knots of another length": ({"half_width_y": 5.0, "knots_x": SQUARE},
                                "'knots_x' must have 13 knots"),
    "list for a number": ({"type": "conic", "radius": 9.0, "conic": [1, 2]},
                          "'conic' must be a number, not [1, 2]"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_ROWS)
def test_bad_rows(case):
    given, said = BAD_ROWS[case]
    coefficients = {} if "type" in given else {"coefficients": rows()}
    data = prescription(**{**coefficients, **given})
    with refused(said, "here: surface 1: "):
        lens_from_prescription(data, where="here")


def test_a_fit_is_a_surface_of_a_prescription():
    x, y = np.meshgrid(GRID, GRID)
    row = fit_b_spline(GRID, GRID, sphere(x, y), SQUARE, SQUARE)
    lens = lens_from_prescription(prescription(**row))
    ball = lens_from_prescription(prescription(type="sphere", radius=50.0))
    efl, expected = (float(each.first_order().efl.detach()) for each in (lens, ball))
    assert efl == pytest.approx(expected, rel=2e-3)
