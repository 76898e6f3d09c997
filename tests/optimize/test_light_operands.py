"""Operands of lost light against closed forms and differences."""

import pytest
import torch

import dolens
from dolens import InputError
from dolens.optimize.operands import LensProperties, operand


@pytest.fixture(scope="module")
def window():
    return dolens.load_lens("coated_window")


def values(lens, **settings):
    """The values of an operand of the lens, without a target."""
    found = operand({"target": 0.0, **settings}, lens)
    return found.values(LensProperties(lens.system(), lens.primary_wavelength, None))


def test_reflectance_of_bare_glass_is_fresnel_s(window):
    bare = window.coated({1: "none", 2: "none"})
    found = values(bare, kind="reflectance", surfaces=[1], wavelengths=[587.5618])
    n = 1.5168
    label = "reflectance/1/587.562/0"
    assert float(found[label].detach()) == pytest.approx(100 * ((n - 1) / (n + 1)) ** 2, rel=1e-4)
    assert [name.split("/")[1] for name in values(bare, kind="reflectance")] == ["1", "2"]


def test_transmission_of_the_chief_ray_is_the_trace_s(window):
    found = values(window, kind="transmission", field=[0.0, 20.0], wavelengths=[450, 650])
    for nm in (450.0, 650.0):
        aimed = window.chief_ray((0.0, 20.0), window.primary_wavelength)
        rays = dolens.Rays(aimed.position, aimed.direction, nm)
        hit = window.trace(rays, transmission=True)
        known = 100.0 * float(hit.transmission.detach())
        assert float(found[f"transmission/0,20/{nm:g}"].detach()) == pytest.approx(known, rel=1e-9)


@pytest.mark.parametrize("kind", ["reflectance", "transmission"])
def test_derivatives_are_those_of_differences(window, kind):
    name = "surfaces.1.coating.thickness_2"
    at = window.variables([name])[name].detach()

    def total(thickness):
        lens = window.with_values({name: thickness})
        return sum(values(lens, kind=kind, wavelengths=[420, 510]).values())

    value = at.clone().requires_grad_()
    slope = float(torch.autograd.grad(total(value), value)[0])
    around = [float(total(at + step).detach()) for step in (1e-3, -1e-3)]
    assert slope == pytest.approx((around[0] - around[1]) / 2e-3, rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "reflectance", "surfaces": [2]}, r"surface 2 has no coating \(allowed: \[1\]\)"),
        ({"kind": "reflectance", "angles": [95.0]}, "angles must be from 0 to 90 degrees"),
        ({"kind": "reflectance", "wavelengths": [-5]}, "wavelength"),
        ({"kind": "reflectance", "colour": 5}, "unknown key 'colour'|colour"),
        ({"kind": "efl", "angles": [5]}, "angles"),
    ],
)
def test_what_cannot_be_meant_is_refused(window, settings, message):
    with pytest.raises(InputError, match=message):
        operand({"target": 0.0, **settings}, window)


def test_reflectance_needs_a_coating():
    with pytest.raises(InputError, match="no surface of the lens has a coating"):
        operand({"kind": "reflectance", "target": 0.0}, dolens.load_lens("cooke_triplet"))
