"""Numbers of figures are written as a journal prints them."""

import pytest

from dolens.optics.fields import field_label
from dolens.plotting.style import line_styles, number_text, value_and_error, with_minus


@pytest.mark.parametrize(
    ("value", "sigma", "printed"),
    [
        (-666.725, 3.3, ("−667", "3")),
        (119.45, 0.0055, ("119.450", "0.005")),
        (1.64, 0.16, ("1.64", "0.16")),
        (123456.0, 1200.0, ("123500", "1200")),
        (5.0, 0.99, ("5", "1")),
        (-0.001, 0.3, ("0.0", "0.3")),
    ],
)
def test_a_value_has_the_digits_that_its_deviation_allows(value, sigma, printed):
    assert value_and_error(value, sigma) == printed


@pytest.mark.parametrize(
    ("value", "printed"),
    [(4e6, "4×10⁶"), (1e-7, "10⁻⁷"), (-4.5, "−4.5"), (96.44, "96.4"), (1200.0, "1200"), (0.0, "0")],
)
def test_powers_of_ten_are_written_as_such(value, printed):
    assert number_text(value) == printed


def test_only_a_hyphen_before_a_number_is_a_minus():
    assert with_minus("(-2, 0)° of U-Net, 3-4") == "(−2, 0)° of U-Net, 3-4"
    assert field_label((-2.0, 0.0), "°") == "(−2, 0)°"


def test_a_field_on_the_y_axis_is_one_number():
    labels = [field_label(point, "mm") for point in ((0.0, -14.0), (3.0, 14.0), (-0.0, -0.0))]
    assert labels == ["−14 mm", "(3, 14) mm", "0 mm"]


def test_no_two_lines_look_alike():
    looks = {(look["color"], str(look["linestyle"])) for look in line_styles(28)}
    assert len(looks) == 28
