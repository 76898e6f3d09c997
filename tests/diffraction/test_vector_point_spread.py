"""Vectorial point spread functions beside the integrals of Richards and Wolf."""

import math

import mpmath
import pytest
import torch

import dolens
from dolens import InputError
from dolens.analysis.conditions import conditions
from dolens.diffraction.field_wavefronts import field_wavefronts
from dolens.diffraction.propagation import direct_field
from dolens.diffraction.vector_point_spread import added_fields, vector_point_spread
from dolens.diffraction.wavefront import Wavefront, covered
from dolens.optics.polarisation import turned
from dolens.prescriptions.build import lens_from_prescription

APERTURE, NM = 0.9, 500.0
EDGE = math.asin(APERTURE)


def richards_wolf(x, y, apodisation):
    """|E_x|², |E_y|², |E_z|² (..., 3) at points in mm, of light along x: Novotny and Hecht,
    Principles of Nano-Optics, (3.58) to (3.66), with ½·k as unit.
    """
    k = 2.0 * math.pi / (1e-6 * NM)
    rows = []
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        rho, phi = math.hypot(a, b), math.atan2(b, a)

        def integral(order, weight, rho=rho):
            def inner(t):
                bessel = mpmath.besselj(order, k * rho * mpmath.sin(t))
                return apodisation(t) * mpmath.sin(t) * weight(t) * bessel

            return float(mpmath.quad(inner, [0, 0.5 * EDGE, EDGE]))

        i00 = integral(0, lambda t: 1 + mpmath.cos(t))
        i01 = integral(1, mpmath.sin)
        i02 = integral(2, lambda t: 1 - mpmath.cos(t))
        fields = (i00 + i02 * math.cos(2 * phi), i02 * math.sin(2 * phi), 2 * i01 * math.cos(phi))
        rows.append([field**2 for field in fields])
    return torch.tensor(rows, dtype=torch.float64)


def aplanatic(side):
    """The wavefront of an aplanatic system without aberrations, whose flux per area in direction
    cosines is 1, and its fields for light along x."""
    u = ((torch.arange(side).double() + 0.5) * (2 / side) - 1.0) * (APERTURE * side / (side - 2))
    b, a = torch.meshgrid(u, u, indexing="ij")
    one, none = torch.ones(1, side, side).double(), torch.zeros(1, side, side, 2).double()
    ray = torch.stack((a, b, (1.0 - a * a - b * b).clamp(min=1e-9).sqrt()), -1)[None]
    wavefront = Wavefront(
        opd=0.0 * one,
        direction=ray[..., :2],
        intercept=none,
        area=one * (u[1] - u[0]) ** 2,
        amplitude=one,
        coverage=covered(APERTURE**2 - a * a - b * b)[None],
        valid=one > 0.0,
        crossings={},
        clipping={},
        ended=torch.tensor([False]),
        centre=none[:, 0, 0],
        curvature=one[:, 0, 0] * 0.0,
        wavelength=one[:, 0, 0] * NM,
        index=one[:, 0, 0],
        landed=none,
    )
    x, _, z = torch.eye(3, dtype=torch.float64)
    fields = turned(x.expand_as(ray), z, ray) / ray[..., 2:].sqrt()
    return wavefront, fields.to(torch.complex128)


def test_an_aplanatic_system_of_aperture_0_9_has_the_integrals_of_richards_and_wolf():
    x = 1e-3 * torch.tensor([0.0, 0.1, 0.3, 0.0, 0.2, 0.5]).double()
    y = 1e-3 * torch.tensor([0.0, 0.0, 0.0, 0.4, 0.2, -0.3]).double()
    known = (math.pi / (1e-6 * NM)) ** 2 * richards_wolf(x, y, lambda t: mpmath.sqrt(mpmath.cos(t)))
    errors = []
    for side in (48, 96):
        found = added_fields(*aplanatic(side), x, y)[0].abs().square()
        errors.append(float((found - known).abs().max() / known.max()))
    # A quarter with twice the rays: what is left is the sampling's.
    assert errors[1] < 1e-4 and errors[1] < 0.3 * errors[0]


def test_a_paraboloid_of_aperture_0_9_from_the_trace_to_the_image():
    focal = 10.0
    mirror = {"type": "conic", "radius": -2 * focal, "conic": -1.0, "material": "mirror"}
    mirror["semi_diameter"] = 2 * focal * math.tan(0.5 * EDGE)
    lens = lens_from_prescription({"surfaces": {"1": mirror}, "sensor": {"distance": -focal}})
    where = conditions(lens, fields=0, wavelengths=NM)
    found = vector_point_spread(lens, where, cells=8, half_width_um=0.8, rays=64, light=(1, 0))
    step = (torch.arange(8).double() + 0.5) * 2e-4 - 8e-4
    which = [(4, 4), (4, 6), (6, 4), (2, 7)]
    x, y = (torch.stack([step[at[axis]] for at in which]) for axis in (1, 0))

    def apodisation(t):
        return 2 / (1 + mpmath.cos(t))

    flux = (
        2 * math.pi * float(mpmath.quad(lambda t: apodisation(t) ** 2 * mpmath.sin(t), [0, EDGE]))
    )
    known = (math.pi / (1e-3 * NM)) ** 2 / flux * richards_wolf(x, y, apodisation)
    parts = torch.stack([found.parts[0, :, row, column] for row, column in which])
    error = float((parts - known).abs().max() / known.max())
    assert error < 1.5 * float(found.sampling_error) < 5e-4
    # Added up as numbers, fields of such an aperture are far off.
    assert 0.1 < float(found.scalar_error) < 0.4


def test_at_low_aperture_fields_add_up_as_numbers():
    errors = []
    for number in (8.0, 16.0):
        lens = dolens.load_lens("cooke_triplet").coated("none").requires_grad_(False)
        lens = dolens.optics.field_and_aperture.with_aperture(lens, f_number=number)
        where = conditions(lens, fields=0, wavelengths=587.5618)
        found = vector_point_spread(lens, where, cells=9, rays=64)
        errors.append(float(found.scalar_error))
        # By symmetry, unpolarised light has as much of x as of y.
        x, y, z = found.parts[0]
        assert float((x - y.T).abs().max() / x.max()) < 1e-6
        assert 0.0 < float(z.max() / x.max()) < 0.01
    assert errors[0] < 2e-3 and errors[1] == pytest.approx(0.25 * errors[0], rel=0.2)


def test_an_image_holds_what_the_lens_passes():
    lens = dolens.load_lens("cooke_triplet").requires_grad_(False)
    where = conditions(lens, fields=20, wavelengths=587.5618)
    settings = {"cells": 12, "half_width_um": 60.0, "rays": 96}
    ideal, bare = (
        vector_point_spread(of, where, **settings).irradiance.sum()
        for of in (lens, lens.coated("none"))
    )
    assert float(bare / ideal) == pytest.approx(0.7021, abs=2e-3)
    step = 120.0 / 12
    assert 0.8 < float(ideal) * step * step < 1.05


def test_one_number_a_ray_is_the_scalar_field():
    lens = dolens.load_lens("cooke_triplet").requires_grad_(False)
    where = conditions(lens, fields=14, wavelengths=587.5618)
    front = field_wavefronts(lens, where, 48).wavefront
    x, y = (1e-3 * torch.tensor(v).double() for v in ([0.0, 2.0, -3.0], [0.0, 1.0, 4.0]))
    one = torch.ones(*front.opd.shape, 1, dtype=torch.complex128)
    error = added_fields(front, one, x, y)[..., 0] - direct_field(front, x, y)
    assert float(error.abs().max() / direct_field(front, x, y).abs().max()) < 1e-12


@pytest.mark.parametrize("light", [(0, 0), (1,), (math.nan, 1)])
def test_light_that_is_none_is_refused(light):
    lens = dolens.load_lens("cooke_triplet")
    with pytest.raises(InputError, match="light: must be E_x and E_y"):
        vector_point_spread(lens, conditions(lens, fields=0), light=light)
