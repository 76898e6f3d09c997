"""A new surface shape is its sag and slopes, its parameters' names, and one registration."""

import math

import pytest
import torch

import dolens
from dolens import InputError, Rays, Status
from dolens.optics.surfaces import SURFACES, Sphere, Surface, unregister_surface
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
def with_wedge(registered):
    registered(Wedge)


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


def test_its_paraxial_properties_follow_from_its_sag(with_wedge, registered):
    """A trough bends in one of two azimuths: half its curvature on average, G = -(bend/2)³/8."""
    assert float(prism({"type": "wedge"}).first_order().power.detach()) == 0.0
    registered(Trough)
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


def test_a_surface_is_known_by_its_kind_once_it_is_registered(registered):
    with pytest.raises(InputError, match=r"type .wedge. is unknown"):
        prism({"type": "wedge"})
    assert registered(Wedge) is Wedge, "usable as a decorator"
    assert SURFACES["wedge"] is Wedge
    prism({"type": "wedge"})


def test_a_class_made_again_takes_the_place_of_the_former(registered):
    """As in a notebook, where a cell is run again."""
    again = type("Wedge", (Wedge,), {"__module__": Wedge.__module__, "__qualname__": "Wedge"})
    registered(Wedge)
    dolens.register_surface(again)
    assert SURFACES["wedge"] is again


def test_a_kind_that_is_taken_is_refused(registered):
    class Ball(Wedge):
        kind = "sphere"

    with pytest.raises(InputError, match=r"Ball: kind 'sphere' is taken by dolens\S+Sphere"):
        registered(Ball)

    class Asphere(Sphere):
        """A shape that keeps the kind of the class that it is made from."""

    with pytest.raises(InputError, match="Asphere: kind 'sphere' is taken"):
        registered(Asphere)
    assert SURFACES["sphere"] is Sphere


class _Nameless(Wedge):
    kind = ""


class _Unfinished(Surface):
    kind = "unfinished"


class _Bound(Wedge):
    kind = "bound"

    def parameter_names(self, keys):
        return []


class _Letters(Wedge):
    kind = "letters"
    arrays = "heights"


class _NoKernel(Wedge):
    kind = "no_kernel"
    kernel = "somewhere"


@pytest.mark.parametrize(
    "shape, wrong",
    [
        (3, "3 is no subclass"),
        (dict, "is no subclass"),
        (Wedge(1.0, {"slope_x": 0.0, "slope_y": 0.0}), "is no subclass"),
        (_Nameless, "`kind` must be"),
        (_Unfinished, "`parameter_names` is missing; `sag_and_gradient` is missing"),
        (_Bound, "`parameter_names` must be a class method"),
        (_Letters, "`arrays` must be a tuple of names"),
        (_NoKernel, "`kernel` must be a SurfaceKernel"),
    ],
)
def test_what_a_class_lacks_is_said_in_one_line(registered, shape, wrong):
    known = dict(SURFACES)
    with pytest.raises(InputError, match=wrong) as raised:
        registered(shape)
    assert "\n" not in str(raised.value)
    assert dict(SURFACES) == known


def test_a_surface_that_is_no_longer_registered_is_unknown():
    dolens.register_surface(Wedge)
    unregister_surface("wedge")
    assert "wedge" not in SURFACES
    with pytest.raises(InputError, match="no kind 'wedge'"):
        unregister_surface("wedge")


def test_a_prescription_names_no_code():
    """A type is looked up among what is registered, and nothing is imported for it."""
    with pytest.raises(InputError, match="is unknown"):
        prism({"type": "tests.kernels.own_surface.paraboloid.Paraboloid"})
