"""What a lens is looked at where neither the caller nor its file says."""

import math

import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import (
    conditions,
    field_scans,
    full_field,
    own_fields,
    spectral_lines,
    wavelength_interval,
)
from dolens.errors import InputError
from dolens.optics.field_and_aperture import with_aperture
from dolens.prescriptions import lens_from_prescription


def window(sensor_diameter=None, behind=10.0, **data):
    """A stop, and a tube behind it whose end lets half of the light of tan θ = 0.5 through."""
    plane = {"type": "plane", "material": "air"}
    sensor = {"distance": behind}
    if sensor_diameter:
        sensor["diameter"] = sensor_diameter
    return lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": {**plane, "semi_diameter": 0.5, "thickness": 10.0},
                "2": {**plane, "semi_diameter": 5.0},
            },
            "sensor": sensor,
            **data,
        }
    )


def test_the_sensor_s_edge_is_the_full_field():
    lens = window(sensor_diameter=8.0)
    edge = math.degrees(math.atan(4.0 / 20.0))
    assert full_field(lens) == pytest.approx(edge, abs=0.05)
    found = conditions(lens)
    assert found.fields.tolist() == [[0.0, 0.0], [0.0, pytest.approx(0.7 * edge, abs=0.05)],
                                     [0.0, pytest.approx(edge, abs=0.05)]]  # fmt: skip
    assert found.wavelengths.tolist() == [587.5618] and found.object_distance is None


def test_apertures_limit_the_full_field_where_half_of_the_light_is_lost():
    for lens in (window(), window(sensor_diameter=1000.0)):
        assert full_field(lens) == pytest.approx(math.degrees(math.atan(0.5)), abs=0.6)


def test_a_lens_that_limits_nothing_has_a_field_of_20_degrees():
    plane = {"type": "plane", "material": "air", "semi_diameter": 1.0}
    lens = lens_from_prescription({"surfaces": {"1": plane}, "sensor": {"distance": 5.0}})
    assert full_field(lens) == 20.0
    height = 100.0 * math.tan(math.radians(20.0))
    assert full_field(lens, 100.0) == pytest.approx(height, rel=2e-3)


def test_own_fields_come_first_and_change_their_kind_with_the_object():
    angles = window(fields={"angles": [[0, 0], [0, 10]]})
    assert own_fields(angles, None).tolist() == [[0.0, 0.0], [0.0, 10.0]]
    # A ray upwards comes from a point below the axis.
    height = -200.0 * math.tan(math.radians(10.0))
    assert own_fields(angles, 200.0).tolist() == [[0.0, 0.0], [0.0, pytest.approx(height)]]
    near = window(fields={"heights": [[0, 5]]}, object_distance=50.0)
    assert own_fields(near, 50.0).tolist() == [[0.0, 5.0]]
    assert own_fields(near, None).tolist() == [[0.0, pytest.approx(-math.degrees(math.atan(0.1)))]]
    assert conditions(near).object_distance == 50.0
    assert conditions(near, object_distance=math.inf).field_unit == "°"


def test_fields_may_be_numbers_along_y(root):
    lens = window()
    assert conditions(lens, 3.0).fields.tolist() == [[0.0, 3.0]]
    assert conditions(lens, [0, 2]).fields.tolist() == [[0.0, 0.0], [0.0, 2.0]]
    assert conditions(lens, [(1, 2)], 500).fields.tolist() == [[1.0, 2.0]]
    for wrong in ([], [[1, 2, 3]], "far", [math.nan]):
        with pytest.raises(InputError, match="fields"):
            conditions(lens, wrong)
    for wrong in ([], [0.0], -5.0):
        with pytest.raises(InputError, match="wavelengths"):
            conditions(lens, 0.0, wrong)
    with pytest.raises(InputError, match="object_distance"):
        conditions(lens, 0.0, object_distance=-1.0)


def test_curves_over_the_field_reach_the_farthest_own_field(root):
    lens = load_lens(root / "conf/lens/double_gauss.yaml")
    (scan,) = field_scans(lens, count=3)
    assert scan.coordinate.tolist() == [0.0, 11.0, 22.0] and scan.axis == "y"
    (diagonal,) = field_scans(lens, edge=(3.0, 4.0), count=2)
    assert diagonal.fields.tolist() == [[0.0, 0.0], [3.0, 4.0]] and diagonal.axis == ""
    for wrong in ({"edge": 0.0}, {"edge": math.inf}, {"count": 1}):
        with pytest.raises(InputError):
            field_scans(lens, **wrong)


def test_a_lens_without_light_has_the_axis_alone():
    plane = {"type": "plane", "material": "air"}
    lens = lens_from_prescription(
        {
            "surfaces": {
                "1": {**plane, "semi_diameter": 1.0, "thickness": 1.0},
                "2": {**plane, "semi_diameter": 1e-9},
            },
            "sensor": {"distance": 5.0},
        }
    )
    assert full_field(lens) == 0.0
    assert own_fields(lens, None).tolist() == [[0.0, 0.0]]


def test_wavelengths_of_curves_cover_the_lens_s_own_or_the_visible_spectrum():
    assert wavelength_interval(window()) == (486.1327, 656.2725)
    assert wavelength_interval(window(wavelengths=[700.0, 900.0])) == (700.0, 900.0)
    assert wavelength_interval(window(wavelengths=[1000.0])) == pytest.approx((950.0, 1050.0))
    assert spectral_lines(window()) == (656.2725, 587.5618, 486.1327)
    assert spectral_lines(window(wavelengths=[500.0, 600.0])) == (500.0, 600.0)


def test_the_stop_is_set_to_an_aperture(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    before = lens.surfaces["4"].semi_diameter
    slower = with_aperture(lens, f_number=8.0)
    assert float(slower.first_order().f_number.detach()) == pytest.approx(8.0)
    wide = with_aperture(lens, entrance_pupil_diameter=5.0)
    assert float(wide.first_order().entrance_pupil.diameter.detach()) == pytest.approx(5.0)
    assert lens.surfaces["4"].semi_diameter == before and with_aperture(lens) is lens
    for wrong in ({"f_number": 0.0}, {"f_number": 4.0, "entrance_pupil_diameter": 3.0},
                  {"entrance_pupil_diameter": math.inf}, {"f_number": 0.01}):  # fmt: skip
        with pytest.raises(InputError):
            with_aperture(lens, **wrong)
    assert isinstance(slower.surfaces["4"].curvature, torch.nn.Parameter)
