"""States of one lens are one least-squares problem: its Jacobian, and what its solution is."""

import pytest
import torch

from dolens import InputError
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings
from dolens.prescriptions import lens_from_prescription
from tests.optics.test_lens_states import DOUBLET

SETTINGS = {"sampling_options": {"rings": 2, "arms": 6}, "reference_spectrum": "polychromatic"}
VARIABLES = {
    "surfaces.[1-4].curvature": {"scale": 0.01},
    "thicknesses.2": None,
    "sensor_distance": None,
    "states.tele.thicknesses.2": None,
    "states.tele.sensor_distance": None,
}


def lens_with(**states):
    return lens_from_prescription(DOUBLET | {"states": states}).requires_grad_(False)


def lens_of_all():
    return lens_from_prescription(DOUBLET).requires_grad_(False)


def merit_of(lens, variables, **settings):
    found = DesignVariables(lens, variables)
    return MeritSettings(**{**SETTINGS, **settings}).build(lens, found), found


def test_the_gradient_is_that_of_finite_differences():
    """Of all states: zoom, a near object, and one that is heated."""
    operands = [
        {"kind": "efl", "target": 60.0, "state": ["wide", "hot"]},
        {"kind": "total_track", "state": "tele", "max": 40.0},
        {"kind": "air_gap", "min": 12.0},
        {"kind": "edge_air_gap", "min": 12.0, "state": "hot"},
    ]
    some = VARIABLES | {"surfaces.[13].curvature": {"scale": 0.01}}
    del some["surfaces.[1-4].curvature"]
    merit, variables = merit_of(lens_of_all(), some, operands=operands)
    gradient = 2.0 * merit().linear_model().gradient
    start = variables.scaled.detach().clone()
    for place in range(len(start)):
        values = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                variables.scaled.copy_(start)
                variables.scaled[place] += sign * 1e-6
            values.append(merit().sum_of_squares())
        slope = (values[0] - values[1]) / 2e-6
        least = 1e-4 * float(gradient.norm())
        assert float(gradient[place]) == pytest.approx(slope, rel=2e-5, abs=least)
    with torch.no_grad():
        variables.scaled.copy_(start)
    loss = merit().loss()
    assert float(loss) == pytest.approx(merit().sum_of_squares(), rel=1e-12)
    (slopes,) = torch.autograd.grad(loss, [variables.scaled])
    assert torch.allclose(slopes, gradient, rtol=1e-8, atol=1e-8 * float(gradient.norm()))


def test_the_jacobian_is_the_stack_of_those_of_separate_lenses():
    """Shared variables have columns in both, a state's own in its rows alone."""
    lens = lens_of_all()
    weights = [1.0, 3.0]
    merit, variables = merit_of(lens, VARIABLES, states=["wide", "tele"], state_weights=weights)
    model = merit().linear_model()
    total = torch.zeros(len(variables.scaled), len(variables.scaled), dtype=torch.float64)
    right = torch.zeros(len(variables.scaled), dtype=torch.float64)
    for state, weight in zip(("wide", "tele"), weights, strict=True):
        there = lens_from_prescription(written(state)).requires_grad_(False)
        own = {
            "surfaces.[1-4].curvature": {"scale": 0.01},
            "thicknesses.2": None,
            "sensor_distance": None,
        }
        alone, of_it = merit_of(there, own)
        part = alone().linear_model()
        names = [
            f"states.tele.{n}" if state == "tele" and not n.startswith("surfaces") else n
            for n in of_it.names
        ]
        at = torch.tensor([variables.names.index(name) for name in names])
        total[at[:, None], at] += weight / 4.0 * part.root.T @ part.root
        right[at] += weight / 4.0 * part.gradient
    assert torch.allclose(
        model.root.T @ model.root, total, rtol=1e-9, atol=1e-9 * float(total.max())
    )
    assert torch.allclose(model.gradient, right, rtol=1e-9, atol=1e-9 * float(right.abs().max()))


def written(state):
    """The prescription of a state of the sample, written out."""
    rows = {n: dict(row) for n, row in DOUBLET["surfaces"].items()}
    overlay = DOUBLET["states"][state]
    for n, row in overlay.get("surfaces", {}).items():
        rows[n] |= row
    sensor = DOUBLET["sensor"] | overlay.get("sensor", {})
    return {**DOUBLET, "surfaces": rows, "sensor": sensor, "states": {}}


def test_two_states_that_are_the_same_give_the_solution_of_one():
    variables = {"surfaces.[12].curvature": {"scale": 0.01}, "sensor_distance": None}
    ends = []
    for lens in (lens_with(), lens_with(a={}, b={})):
        merit, found = merit_of(lens, variables)
        optimizer = DampedLeastSquares([found.parameter_group()])
        for _ in range(8):
            optimizer.step(merit)
        ends.append((merit().sum_of_squares(), found.scaled.detach().clone()))
    assert ends[0][0] == pytest.approx(ends[1][0], rel=1e-9)
    assert torch.allclose(ends[0][1], ends[1][1], rtol=1e-5)


def test_groups_move_by_pickups_and_each_state_has_its_best_focus():
    """The gap behind a group is what the gap before it leaves, in every state."""
    rows = {"1": {"thickness": 3.0}, "2": {"thickness": 10.0}, "3": {"thickness": 2.0}}
    lens = lens_with(**{name: {"surfaces": rows, "sensor": {"distance": 40.0}} for name in "ab"})
    merit, variables = merit_of(
        lens,
        {
            "states.a.thicknesses.2": {"lower": 5.0},
            "states.b.thicknesses.2": {"initial": 8.0},
            "states.*.thicknesses.3": {
                "pickup": ["states.*.thicknesses.1", "states.*.thicknesses.2"],
                "factor": -1.0,
                "offset": 15.0,
            },
            "states.*.sensor_distance": {"solve": "best_focus"},
        },
    )
    assert variables.names == ["states.a.thicknesses.2", "states.b.thicknesses.2"]
    value = merit()
    value.write_to(lens)
    assert float(lens.in_state("b").thicknesses["3"]) == 15.0 - 3.0 - 8.0
    least = value.qualities["b"].merit
    for shift in (-0.01, 0.01):
        with torch.no_grad():
            moved = lens.in_state("b")
            moved.sensor_distance += shift
            assert merit.parts["b"].quality.values(moved).merit > least
            moved.sensor_distance -= shift
    assert {name for name in value.foci()} == {f"states.{n}.sensor_distance" for n in "ab"}


def test_operands_are_of_the_states_that_they_name():
    lens = lens_of_all()
    operands = [{"kind": "efl", "target": 1.0}, {"kind": "bfd", "min": 1.0, "state": "tele"}]
    merit, _ = merit_of(lens, VARIABLES, quality=None, operands=operands)
    found = {item.label: item.value for item in merit().operands}
    assert list(found) == ["wide/efl", "tele/efl", "tele/bfd", "near/efl", "hot/efl"]
    for state in lens.state_names:
        there = lens.in_state(state)
        first = there.first_order(there.primary_wavelength, there.object_distance)
        assert found[f"{state}/efl"] == pytest.approx(float(first.efl), rel=1e-12)


@pytest.mark.parametrize(
    ("variables", "settings", "said"),
    [
        ({"sensor_distance": {"solve": "best_focus"}}, {}, "a sensor that all states share"),
        ({"surfaces.1.curvature": None}, {"states": ["far"]}, "no state 'far'"),
        ({"surfaces.1.curvature": None}, {"state_weights": [1.0]}, "give 4 numbers"),
        ({"thicknesses.2": None}, {"states": ["tele"]}, "vary states.*.thicknesses.2"),
        (
            {"states.tele.thicknesses.2": None},
            {"states": ["wide"]},
            r"its state is none of merit.states \(wide\)",
        ),
        (
            {"surfaces.1.curvature": None},
            {"operands": [{"kind": "efl", "target": 1.0, "state": "far"}]},
            "no state 'far'",
        ),
    ],
)
def test_a_mistake_takes_one_line(variables, settings, said):
    with pytest.raises(InputError, match=said) as refusal:
        bfd = {"operands": [{"kind": "bfd", "min": 1.0}], "quality": None}
        merit_of(lens_of_all(), variables, **{**bfd, **settings})
    assert "\n" not in str(refusal.value)
