"""A new surface shape is its sag and slopes, its parameters' names, and nothing else."""

import math

import pytest
import torch

from dolens import Rays, Status
from dolens.optics.surfaces import SURFACES, Surface
from dolens.prescriptions import lens_from_prescription, prescription_of


class Wedge(Surface):
    """A plane that leans: z = x·slope_x + y·slope_y."""

    kind = "wedge"

    @classmethod
    def parameter_names(cls, keys):
        return ["slope_x", "slope_y"]

    @classmethod
    def sag_and_gradient(cls, p, x, y):
        sag = p["slope_x"] * x + p["slope_y"] * y
        return sag, p["slope_x"].expand_as(sag), p["slope_y"].expand_as(sag), None


@pytest.fixture
def with_wedge(monkeypatch):
    monkeypatch.setitem(SURFACES, "wedge", Wedge)


def prism(back, **more):
    """Glass from a plane to `back`."""
    return lens_from_prescription(
        {
            "surfaces": {
                "1": {"type": "plane", "semi_diameter": 10.0, "thickness": 6.0,
                      "material": "1.5168/64.17"},
                "2": {"semi_diameter": 10.0, "material": "air"} | back,
            },
            "sensor": {"distance": 20.0},
        }
        | more
    )  # fmt: skip


def bundle():
    generator = torch.Generator().manual_seed(2)
    position = torch.rand((40, 3), generator=generator, dtype=torch.float64) * 8.0 - 4.0
    direction = torch.randn((40, 3), generator=generator, dtype=torch.float64) * 0.2
    direction[:, 2] = 1.0
    return Rays(position, direction / direction.norm(dim=-1, keepdim=True), 550.0)


def test_a_shape_defined_in_ten_lines_is_traced_exactly(with_wedge):
    """A leaning plane is a plane tilted by the arctangent: two ways that share no step."""
    lens = prism({"type": "wedge", "slope_x": 0.0, "slope_y": 0.3})
    tilt = {"surfaces": [2, 2], "tilt_x": math.degrees(math.atan(0.3))}
    same = prism({"type": "plane"}, elements={"1": tilt})
    a, b = lens.trace(bundle(), record=True), same.trace(bundle(), record=True)
    assert a.valid.sum() > 30
    assert torch.equal(a.status, b.status)
    assert (a.points - b.points)[:, a.valid].abs().max() < 1e-13
    assert (a.direction - b.direction)[a.valid].abs().max() < 1e-14
    assert (a.path_length - b.path_length)[a.valid].abs().max() < 1e-13


class Trough(Surface):
    """A cylindrical parabola, z = bend·x²/2."""

    kind = "trough"

    @classmethod
    def parameter_names(cls, keys):
        return ["bend"]

    @classmethod
    def sag_and_gradient(cls, p, x, y):
        return 0.5 * p["bend"] * x * x, p["bend"] * x, torch.zeros_like(y * x), None


def test_its_paraxial_properties_follow_from_its_sag(with_wedge, monkeypatch):
    """A trough bends in one of two azimuths: half its curvature on average, G = -(bend/2)³/8."""
    assert float(prism({"type": "wedge"}).first_order().power.detach()) == 0.0
    monkeypatch.setitem(SURFACES, "trough", Trough)
    lens = prism({"type": "trough", "bend": 0.02})
    expected = (1.0 - 1.5168) * 0.5 * 0.02
    assert float(lens.first_order().power.detach()) == pytest.approx(expected, rel=1e-13)
    surface = lens.surfaces["2"]
    departure = surface.fourth_order_departure(dict(surface.named_parameters()))
    assert float(departure.detach()) == pytest.approx(-(0.01**3) / 8.0, rel=1e-13)


def test_it_has_gradients_a_prescription_and_statuses(with_wedge):
    lens = prism({"type": "wedge", "slope_x": 0.1, "slope_y": -0.2})
    again = lens_from_prescription(prescription_of(lens))
    assert again.variables(["surfaces.2.*"]).keys() == {"surfaces.2.slope_x", "surfaces.2.slope_y"}

    def total(slope_x, slope_y):
        values = {"surfaces.2.slope_x": slope_x, "surfaces.2.slope_y": slope_y}
        hit = torch.func.functional_call(lens, values, (bundle(),))
        return hit.position[hit.valid].square().sum()

    slopes = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.1, -0.2)]
    assert torch.autograd.gradcheck(total, slopes)
    assert torch.autograd.gradgradcheck(total, slopes)
    steep = prism({"type": "wedge", "slope_x": 2.0, "slope_y": 0.0})
    axis = Rays(torch.tensor([0.0, 0.0, -1.0]).double(), torch.tensor([0.0, 0.0, 1.0]).double())
    assert int(steep.trace(axis).status) == Status.TIR
