"""First-order optics in plain numbers says what the differentiable one does, and textbooks do."""

import math
from decimal import Decimal

import pytest
import torch
import yaml

from dolens.optics.paraxial import TwoRays, chief_ray_magnification, exit_pupil, through_surfaces
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.prescriptions import lens_from_prescription

LENSES = ["cooke_triplet", "double_gauss", "large_fov_doublet", "nikon", "wavefront_coding"]


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("wavelength", [486.1327, 656.2725])
def test_the_lenses_pupils_and_magnifications(root, name, wavelength):
    """`paraxial` is itself tested against closed forms and reference data."""
    prescription = yaml.safe_load((root / f"conf/lens/{name}.yaml").read_text())
    system = lens_from_prescription(prescription).double().system()
    numbers = ParaxialNumbers.of(system)
    z, diameter = numbers.exit_pupil(wavelength)
    wanted = exit_pupil(system, wavelength)
    assert z == pytest.approx(float(wanted.z.detach()), rel=1e-12)
    assert diameter == pytest.approx(float(wanted.diameter.detach()), rel=1e-12)
    for depth in (500.0, 1e6):
        found = numbers.chief_ray_magnification(wavelength, depth)
        assert found == pytest.approx(
            float(chief_ray_magnification(system, wavelength, depth).detach()), rel=1e-11
        )


def test_a_stop_at_the_front_focus_is_seen_at_infinity():
    """Telecentric: D = 1 - t/f is nothing at t = f, and a stop there magnifies as the lens does."""
    lens = ParaxialNumbers(
        (0.0, 0.02, 0.0), (100.0, 0.0), 120.0, (_Air(), _Air(), _Glass(), _Air()), 1, 5.0,
        (1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip
    assert lens.exit_pupil(550.0) == (math.inf, math.inf)
    # Chief rays through the front focus leave parallel to the axis: -f/(depth) for f = 100.
    assert lens.chief_ray_magnification(550.0, 400.0) == pytest.approx(-100.0 / 400.0)


@pytest.mark.parametrize("name", LENSES)
def test_paraxial_rays_are_those_of_28_digits(root, name):
    """The same recurrence in decimals, from the same rays: rounding leaves parts in 10¹⁴."""
    prescription = yaml.safe_load((root / f"conf/lens/{name}.yaml").read_text())
    lens = lens_from_prescription(prescription, torch.float64).requires_grad_(False)
    system = lens.system()
    rays = lens.paraxial_rays(5.0, 587.5618)
    curvatures = [s.shape.paraxial_curvature(s.parameters) for s in system.surfaces]
    c, t, n = (
        [Decimal(float(v)) for v in values]
        for values in (curvatures, system.thicknesses, system.indices(587.5618))
    )
    y, u = (
        [Decimal(float(getattr(ray, what)[0])) for ray in rays[:2]]
        for what in ("height", "slope_before")
    )
    exact = list(through_surfaces(TwoRays(*y, n[0] * u[0], n[0] * u[1]), c, t, n))
    for ray, height, slope in ((rays.marginal, 0, 2), (rays.chief, 1, 3)):
        for found, wanted in (
            (ray.height, [step[height] for step in exact]),
            (ray.slope_after, [step[slope] / n[i + 1] for i, step in enumerate(exact)]),
        ):
            wanted = torch.tensor([float(w) for w in wanted], dtype=torch.float64)
            error = found - wanted
            assert float(error.abs().max()) < 3e-14 * float(found.abs().max())


class _Air:
    def index(self, wavelength):
        return 1.0


class _Glass:
    def index(self, wavelength):
        return torch.tensor(1.5, dtype=torch.float64)
