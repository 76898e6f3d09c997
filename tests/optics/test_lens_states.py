"""A lens in a state shares what is common, and has its own what differs: values and gradients."""

import copy

import pytest
import torch

from dolens import InputError, Rays
from dolens.optics.lens_states import values_there
from dolens.optics.parameter_names import to_file_units
from dolens.prescriptions import lens_from_prescription

SHARED, OWN = "surfaces.1.curvature", "states.tele.thicknesses.2"
DOUBLET = {
    "name": "Two lenses",
    "stop": 1,
    "wavelengths": [587.5618],
    "fields": {"angles": [[0, 0], [0, 3]]},
    "surfaces": {
        "1": {"type": "even_asphere", "radius": 40.0, "conic": -0.3, "a4": 1e-7,
              "semi_diameter": 5, "thickness": 3.0, "material": "SCHOTT:N-BK7"},
        "2": {"type": "sphere", "radius": -60.0, "semi_diameter": 5, "thickness": 10.0,
              "material": "air", "thermal_expansion": 23.0},
        "3": {"type": "sphere", "radius": -50.0, "semi_diameter": 6, "thickness": 1.5,
              "material": "SCHOTT:F2"},
        "4": {"type": "sphere", "radius": 90.0, "semi_diameter": 6, "material": "air"},
    },
    "sensor": {"distance": 40.0},
    "states": {
        "wide": {},
        "tele": {
            "surfaces": {"2": {"thickness": 14.0}, "1": {"a4": 2e-7, "semi_diameter": 4.0}},
            "sensor": {"distance": 33.0},
        },
        "near": {"object_distance": 500.0, "fields": {"heights": [[0, 0], [0, 20]]}},
        "hot": {"temperature": 60.0},
    },
}  # fmt: skip


@pytest.fixture
def lens():
    return lens_from_prescription(DOUBLET)


def rays():
    y = torch.linspace(-3.0, 3.0, 5, dtype=torch.float64)
    position = torch.stack([0.1 * y, y, torch.zeros_like(y) - 5.0], -1)
    direction = torch.tensor([0.0, 0.05, 1.0], dtype=torch.float64)
    return Rays(position, (direction / direction.norm()).expand_as(position), 587.5618)


def landing(lens):
    return lens.trace(rays()).position[:, 1].square().sum()


def test_a_state_has_its_own_numbers_and_the_lens_s_others(lens):
    tele = lens.in_state("tele")
    assert lens.state_names == ("wide", "tele", "near", "hot")
    assert tele.surfaces["1"].curvature is lens.surfaces["1"].curvature
    assert tele.thicknesses["2"] is lens.get_parameter(OWN)
    assert (float(tele.thicknesses["2"]), float(lens.thicknesses["2"])) == (14.0, 10.0)
    assert (tele.surfaces["1"].semi_diameter, lens.surfaces["1"].semi_diameter) == (4.0, 5.0)
    assert lens.in_state("near").object_distance == 500.0
    assert lens.in_state("near").fields.kind == "heights"
    assert tele.state_names == () and lens.in_state(None) is lens
    assert set(lens.variables(["states.*.thicknesses.*"])) == {OWN}
    assert to_file_units(OWN, 3.0) == 3.0


def test_a_state_traces_as_the_lens_that_it_describes(lens):
    """Against the same prescription written out."""
    rows = {n: dict(row) for n, row in DOUBLET["surfaces"].items()}
    rows["2"]["thickness"], rows["1"]["a4"], rows["1"]["semi_diameter"] = 14.0, 2e-7, 4.0
    written = {**DOUBLET, "surfaces": rows, "sensor": {"distance": 33.0}, "states": {}}
    alone = lens_from_prescription(written)
    assert torch.equal(lens.in_state("tele").trace(rays()).position, alone.trace(rays()).position)


@pytest.mark.parametrize("name", [SHARED, "states.tele.surfaces.1.a4", OWN])
def test_gradients_flow_to_what_is_shared_and_to_the_state_s_own(lens, name):
    parameter = lens.get_parameter(name)
    (slope,) = torch.autograd.grad(landing(lens.in_state("tele")), [parameter])
    step = 1e-7 if "a4" not in name else 1e-10
    values = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            parameter += sign * step
            values.append(float(landing(lens.in_state("tele"))))
            parameter -= sign * step
    assert float(slope) == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=1e-6)


def test_the_lens_itself_knows_nothing_of_its_states(lens):
    slopes = torch.autograd.grad(landing(lens), [lens.get_parameter(OWN)], allow_unused=True)
    assert slopes == (None,)
    with pytest.raises(InputError, match=r"no parameter 'states\.tele\.thicknesses\.2'"):
        lens.system({OWN: torch.tensor(1.0)})


def test_copies_and_state_dicts_hold_the_states(lens):
    other = copy.deepcopy(lens)
    assert other.get_parameter(OWN) is not lens.get_parameter(OWN)
    assert other.in_state("tele").thicknesses["2"] is other.get_parameter(OWN)
    with torch.no_grad():
        lens.get_parameter(OWN).fill_(15.0)
    assert float(other.in_state("tele").thicknesses["2"]) == 14.0
    other.load_state_dict(lens.state_dict())
    assert float(other.in_state("tele").thicknesses["2"]) == 15.0
    assert lens.to(torch.float32).in_state("tele").dtype == torch.float32


def test_a_heated_state_is_the_heated_lens(lens):
    hot, heated = lens.in_state("hot"), lens.at(60.0)
    assert hot.temperature == 60.0
    assert torch.equal(hot.trace(rays()).position, heated.trace(rays()).position)
    assert not any(parameter.requires_grad for parameter in hot.parameters())


def test_a_heated_lens_is_heated_in_all_its_states(lens):
    """To heat and to zoom may come in either order."""
    first, last = lens.at(60.0).in_state("tele"), lens.in_state("tele").at(60.0)
    assert torch.equal(first.trace(rays()).position, last.trace(rays()).position)
    apertures = [[s.aperture for s in one.surfaces.values()] for one in (first, last)]
    assert apertures[0] == apertures[1]


@pytest.mark.parametrize("name", [SHARED, "thicknesses.2", "surfaces.3.curvature"])
def test_a_heated_state_s_parameters_follow_with_their_derivatives(lens, name):
    """An air gap follows from the curvatures beside it, at the edges that hold it."""
    hot = lens.in_state("hot")

    def found(value):
        return landing_of(hot, values_there(lens, "hot", {name: value}))

    start = lens.get_parameter(name).detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(start), [start])
    step = 1e-7
    difference = (found(start.detach() + step) - found(start.detach() - step)) / (2.0 * step)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)
    assert float(found(start.detach())) == pytest.approx(float(landing(hot)), rel=1e-12)


def test_given_values_follow_a_lens_into_its_states(lens):
    name = "surfaces.1.curvature"
    value = 1.01 * lens.get_parameter(name).detach()
    with torch.no_grad():
        for state in lens.state_names:
            there = values_there(lens, state, {name: value})
            found = landing_of(lens.with_values({name: value}).in_state(state), None)
            assert torch.equal(found, landing_of(lens.in_state(state), there)), state


def landing_of(lens, values):
    from dolens.optics.ray_tracing import trace_rays

    return trace_rays(lens.system(values), rays()).position[:, 1].square().sum()


def test_a_state_that_there_is_not_is_answered_with_those_that_there_are(lens):
    with pytest.raises(InputError, match=r"no state 'tale'; did you mean 'tele'.*wide, tele, near"):
        lens.in_state("tale")


def test_a_lens_with_values_is_hot_with_them_in_all_its_states(lens):
    values = {
        "surfaces.4.curvature": torch.tensor(0.02, dtype=torch.float64, requires_grad=True) * 1.0,
        OWN: torch.tensor(13.0, dtype=torch.float64),
    }
    stored = copy.deepcopy(lens)
    with torch.no_grad():
        for name, value in values.items():
            stored.get_parameter(name).copy_(value)
    found, expected = lens.with_values(values).at(80.0), stored.at(80.0)
    for name in (None, "wide", "tele"):
        assert torch.equal(landing(found.in_state(name)), landing(expected.in_state(name)))


def test_a_lens_in_none_of_its_states_has_no_values_of_theirs(lens):
    values = {"surfaces.4.curvature": torch.tensor(0.02).double(), OWN: torch.tensor(13.0).double()}
    alone = lens.with_values(values).in_state(None)
    assert set(alone.given) == {"surfaces.4.curvature"}
    assert torch.equal(landing(alone), landing(lens.with_values(alone.given)))
