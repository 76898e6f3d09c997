"""B-spline surfaces that cannot be, and what is said of them."""

import math

import pytest

from dolens import InputError
from dolens.optics.surfaces import BSpline
from dolens.optics.surfaces.b_spline import clamped_knots
from tests.optics.spline_samples import KNOTS

FOUR = [[0.0] * 4 for _ in range(4)]
BAD = {
    "no coefficients": ({"half_width": 5.0}, "'coefficients' are missing"),
    "no knots": ({"coefficients": FOUR}, "give one of 'knots_x', 'half_width_x' and 'half_width'"),
    "knots of one axis": ({"coefficients": FOUR, "knots_x": KNOTS["one span"]},
                          "give one of 'knots_y', 'half_width_y' and 'half_width' .mm., not none"),
    "knots twice": ({"coefficients": FOUR, "half_width": 5.0, "knots_x": KNOTS["one span"]},
                    "not 'knots_x' and 'half_width'"),
    "three rows": ({"coefficients": FOUR[:3], "half_width": 5.0},
                   "at least 4 rows .y. of at least 4 numbers .x., not 3 × 4"),
    "one number": ({"coefficients": 1.0, "half_width": 5.0}, "not one number"),
    "a cube": ({"coefficients": [FOUR], "half_width": 5.0}, "not 1 × 4 × 4"),
    "ragged rows": ({"coefficients": [[0.0] * 4, [0.0] * 5] * 2, "half_width": 5.0},
                    "'coefficients' must be numbers, in rows of equal length"),
    "words": ({"coefficients": "flat", "half_width": 5.0}, "'coefficients' must be numbers"),
    "no width": ({"coefficients": FOUR, "half_width": 0.0}, "half width must be a positive number"),
    "too narrow": ({"coefficients": FOUR, "half_width": 3.9},
                   "the aperture reaches 4 mm and exceeds the surface, whose knots 'knots_x' end"),
    "unknown name": ({"coefficients": FOUR, "half_width": 5.0, "curvature": 0.1},
                     "b_spline: unknown key 'curvature'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_surfaces(case):
    given, said = BAD[case]
    with pytest.raises(InputError, match=said) as error:
        BSpline(4.0, given)
    assert "\n" not in str(error.value)


BAD_KNOTS = {
    "too few": ([-5.0] * 4 + [5.0] * 3, "'knots_y' must have 8 knots, 4 more than .* not 7"),
    "decreasing": ([-5.0, -5, -5, -5, 5, 4, 5, 5], "must not decrease, as from 5 to 4"),
    "not a number": ([-5.0, -5, -5, math.nan, 5, 5, 5, 5], "'knots_y' must be finite"),
    "infinite": ([-5.0, -5, -5, -5, 5, 5, 5, math.inf], "'knots_y' must be finite"),
    "nearly repeated": ([-5.0, -5, -5, -5, 5, 5, 5, 5.000001],
                        "too close; repeat a knot exactly, or leave 1e-05 mm between"),
    "no width": ([1.0] * 8, "knot 1 is repeated more than 4 times"),
    "ended early": ([-5.0, -5, -5, -4, -4, 5, 5, 5], "-4 ends the spline"),
    "nested": ([[-5.0] * 4, [5.0] * 4], "'knots_y' must be one list of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_KNOTS)
def test_bad_knots(case):
    knots, said = BAD_KNOTS[case]
    with pytest.raises(InputError, match=said) as error:
        BSpline(4.0, {"coefficients": FOUR, "half_width_x": 5.0, "knots_y": knots})
    assert "\n" not in str(error.value)


def test_a_knot_of_multiplicity_five_is_refused():
    knots = [-5.0] * 4 + [0.0] * 5 + [5.0] * 4
    with pytest.raises(InputError, match="knot 0 is repeated more than 4 times"):
        BSpline(4.0, {"coefficients": [[0.0] * 9] * 4, "knots_x": knots, "half_width_y": 5.0})


def test_clamped_knots_are_symmetric():
    for count in (4, 7, 10, 33):
        knots = clamped_knots(0.7, count)
        assert len(knots) == count + 4
        assert knots == [-k for k in reversed(knots)]
        assert knots[:4] == [-0.7] * 4
    with pytest.raises(InputError, match="at least 4 coefficients a side, not 3"):
        clamped_knots(1.0, 3)
