"""Design variables: scaled, bounded, named (S17)."""

import re

import pytest
import torch

from dolens import InputError, load_lens
from dolens.optimize import DesignVariables
from dolens.prescriptions import lens_from_prescription

X3, Y3 = "surfaces.5.x3", "surfaces.5.y3"


@pytest.fixture
def lens(root):
    return load_lens(root / "conf" / "lens" / "wavefront_coding.yaml")


def test_values_are_scale_times_what_the_optimizer_holds(lens):
    variables = DesignVariables(lens, {X3: {"scale": 1e-5, "initial": 2e-5}, Y3: {"scale": 1e-4}})
    assert torch.allclose(variables.scaled, torch.tensor([2.0, 0.0]).double(), rtol=1e-15)
    theta = variables()
    assert float(theta[X3].detach()) == pytest.approx(2e-5, rel=1e-15)
    (gradient,) = torch.autograd.grad(3 * theta[X3] + 5 * theta[Y3], variables.scaled)
    assert gradient.tolist() == pytest.approx([3e-5, 5e-4], rel=1e-15)
    assert float(lens.surfaces["5"].x3.detach()) == 0.0


def test_patterns_and_the_lens_own_values(lens):
    variables = DesignVariables(lens, {"surfaces.[123].curvature": None, "sensor_distance": {}})
    stored = dict(lens.named_parameters())
    assert len(variables) == 4
    for name, value in variables().items():
        assert torch.equal(value, stored[name])


def test_projection_puts_variables_back_within_their_bounds(lens):
    settings = {"scale": 1e-5, "lower": -2e-5, "upper": 3e-5}
    variables = DesignVariables(lens, {X3: settings, Y3: settings, "sensor_distance": None})
    with torch.no_grad():
        variables.scaled.copy_(torch.tensor([-7.0, 9.0, 1e6]))
    variables.project()
    found = [float(v.detach()) for v in variables().values()]
    assert found == pytest.approx([-2e-5, 3e-5, 1e6], rel=1e-15)
    with torch.no_grad():
        variables.scaled.copy_(torch.tensor([0.5, -0.5, 1.0]))
    variables.project()
    assert variables.scaled.tolist() == [0.5, -0.5, 1.0]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"initial": 2.0, "upper": 1.0}, "initial value 2 is outside its bounds [-inf, 1]"),
        ({"initial": -2.0, "lower": -1.0}, "initial value -2 is outside its bounds [-1, inf]"),
        ({"lower": 1.0, "upper": -1.0}, "outside its bounds [1, -1]"),
        ({"scale": 0.0}, "scale must be positive, not 0"),
        ({"scale": -1.0}, "scale must be positive, not -1"),
        ({"scale": "big"}, "scale must be a number, not 'big'"),
        (
            {"uper": 1.0},
            "unknown key 'uper'; did you mean 'upper'? (allowed: scale, initial, lower, upper)",
        ),
    ],
)
def test_bad_settings(lens, settings, said):
    with pytest.raises(InputError, match=re.escape(said)) as error:
        DesignVariables(lens, {X3: settings})
    assert f"variable '{X3}'" in str(error.value)


def test_unknown_and_repeated_variables(lens):
    with pytest.raises(InputError, match=r"no parameter 'surfaces\.5\.x4'"):
        DesignVariables(lens, {"surfaces.5.x4": None})
    with pytest.raises(InputError, match="is named twice"):
        DesignVariables(lens, {X3: None, "surfaces.5.*": None})


def test_writing_to_a_lens_and_state(lens):
    variables = DesignVariables(lens, {X3: {"scale": 1e-5, "initial": 1e-5}, Y3: {"scale": 1e-5}})
    with torch.no_grad():
        variables.scaled.copy_(torch.tensor([1.25, -2.5]))
    variables.write_to(lens)
    assert float(lens.surfaces["5"].x3.detach()) == pytest.approx(1.25e-5, rel=1e-15)
    assert float(lens.surfaces["5"].y3.detach()) == pytest.approx(-2.5e-5, rel=1e-15)
    assert float(lens.surfaces["5"].x2y.detach()) == 0.0
    other = DesignVariables(lens, {X3: {"scale": 1.0}, Y3: {"scale": 1.0}})
    other.load_state_dict(variables.state_dict())
    for name, value in variables().items():
        assert torch.equal(other()[name], value)


def test_an_array_is_one_variable_with_many_elements():
    heights = [[0.01 * (i + j) for i in range(5)] for j in range(4)]
    freeform = lens_from_prescription(
        {
            "surfaces": {
                "1": {"type": "b_spline", "coefficients": heights, "half_width": 3.0,
                      "semi_diameter": 2.5, "material": "1.5168/64.17"},
            },
            "sensor": {"distance": 10.0},
        }
    )  # fmt: skip
    name = "surfaces.1.coefficients"
    variables = DesignVariables(
        freeform, {"sensor_distance": None, name: {"scale": 0.01, "upper": 0.075}}
    )
    assert (len(variables), variables.scaled.numel()) == (2, 21)
    assert torch.allclose(variables()[name], torch.tensor(heights, dtype=torch.float64))
    with torch.no_grad():
        variables.scaled[1:] += 1.0
    variables.project()
    expected = (torch.tensor(heights, dtype=torch.float64) + 0.01).clamp(max=0.075)
    assert torch.allclose(variables()[name], expected, rtol=1e-14)
    variables.write_to(freeform)
    assert torch.allclose(freeform.surfaces["1"].coefficients, expected, rtol=1e-14)
    # The rays see the values, not the stored coefficients, and send their gradient back.
    system = freeform.system(variables())
    assert system.surfaces[0].parameters["coefficients"].grad_fn is not None
