"""Degrees and mm in files and configuration, radians and mm in a lens, whoever writes them."""

import math

import pytest
import torch

from dolens import InputError
from dolens.alignment.pose import Pose
from dolens.optics.parameter_names import file_value, to_file_units, to_lens_units, unit_of
from dolens.optimize import DesignVariables
from dolens.optimize.variables import start_values
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.tolerancing import tolerances_from

TILT = "elements.front.tilt_x"


def singlet(**pose):
    """A lens whose element has this pose, degrees and mm."""
    return lens_from_prescription(
        {
            "name": "Singlet",
            "surfaces": {
                "1": {"radius": 40.0, "semi_diameter": 5.0, "thickness": 4.0,
                      "material": "1.5168/64.17"},
                "2": {"radius": -60.0, "semi_diameter": 5.0, "material": "air"},
            },
            "elements": {"front": {"surfaces": [1, 2], **pose}},
            "sensor": {"distance": 50.0},
        }
    )  # fmt: skip


def tilt_of(lens):
    return float(lens.elements["front"].tilt_x.detach())


@pytest.mark.parametrize("degrees", [0.1, -7.3, 30.0, 1.0 / 3.0])
def test_one_tilt_is_one_lens_however_it_is_written(degrees):
    """A prescription, a design variable, a start, a pose and a tolerance, to the last bit."""
    expected = tilt_of(singlet(tilt_x=degrees))
    assert expected == math.radians(degrees)

    designed = singlet()
    DesignVariables(designed, {TILT: {"initial": degrees}}).write_to(designed)
    assert tilt_of(designed) == expected

    begun = start_values(singlet(), {TILT: degrees}, torch.Generator())
    added = start_values(singlet(), {TILT: {"add": degrees}}, torch.Generator())
    assert float(begun[TILT]) == float(added[TILT]) == expected

    posed = Pose(singlet(), [[0.0, 0.0, -500.0]], {})
    posed.put({TILT: degrees})
    assert tilt_of(posed.lens) == expected
    fitted = Pose(singlet(), [[0.0, 0.0, -500.0]], {TILT: {"initial": degrees}})
    fitted.store()
    assert tilt_of(fitted.lens) == expected

    tolerances = tolerances_from(singlet(), {TILT: abs(degrees)})
    assert float(tolerances.steps) == abs(expected)
    assert prescription_of(designed)["elements"]["front"]["tilt_x"] == pytest.approx(
        degrees, rel=1e-15
    )


def test_scales_and_bounds_of_a_tilt_are_degrees():
    """Scaled by 0.5°, a tilt of 2° is 4, and a bound of 3° is 6; the lens's own value begins."""
    settings = {"scale": 0.5, "lower": -1.0, "upper": 3.0}
    variables = DesignVariables(singlet(tilt_x=2.0), {TILT: settings})
    assert variables.scaled.tolist() == pytest.approx([4.0], rel=1e-15)
    assert (variables.lower.tolist(), variables.upper.tolist()) == ([-2.0], [6.0])
    assert float(variables()[TILT].detach()) == pytest.approx(math.radians(2.0), rel=1e-15)
    assert variables.file_values() == pytest.approx({TILT: 2.0}, rel=1e-15)
    assert variables.unit_names == ["deg"]
    with pytest.raises(InputError, match=r"initial value 4 is outside its bounds \[-1, 3\]"):
        DesignVariables(singlet(), {TILT: {**settings, "initial": 4.0}})


def test_an_offset_of_a_pickup_and_errors_of_a_start_are_degrees():
    lens = singlet(tilt_x=1.0)
    settings = {TILT: None, "elements.front.tilt_y": {"pickup": TILT, "offset": 0.5}}
    values = DesignVariables(lens, settings)()
    assert float(values["elements.front.tilt_y"].detach()) == pytest.approx(math.radians(1.5))
    errors = [
        float(start_values(lens, {TILT: {key: 2.0}}, torch.Generator().manual_seed(1))[TILT])
        for key in ("absolute", "relative")
    ]
    # Two degrees, and twice one degree.
    assert errors[0] == pytest.approx(errors[1], rel=1e-12)


def test_units_by_name():
    names = {
        "surfaces.1.curvature": "1/mm",
        "surfaces.2.conic": "",
        "thicknesses.3": "mm",
        "sensor_distance": "mm",
        TILT: "deg",
        "elements.front.shift_z": "mm",
        "sources.1.z": "mm",
        "sources.*.x": "mm",
    }
    assert {name: unit_of(name).name for name in names} == names
    assert to_lens_units("thicknesses.3", 1.25) == to_file_units("thicknesses.3", 1.25) == 1.25


def test_every_tilt_that_degrees_can_write_is_found_again():
    for degrees in torch.linspace(-40.0, 40.0, 997, dtype=torch.float64).tolist():
        radians = to_lens_units(TILT, degrees)
        assert to_lens_units(TILT, file_value(TILT, radians)) == radians


@pytest.mark.parametrize("wrong", [math.inf, "far", {"add": math.nan}, {"relative": True}])
def test_a_start_that_is_no_finite_number_is_refused_with_its_pattern(wrong):
    with pytest.raises(InputError, match=f"^start '{TILT}': .* must be a finite number"):
        start_values(singlet(), {TILT: wrong}, torch.Generator())
