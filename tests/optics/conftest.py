import math

import pytest
import torch

import dolens
from dolens import Rays, load_lens
from dolens.optics.surfaces import unregister_surface
from dolens.prescriptions import lens_from_prescription

# A singlet whose back is an XY polynomial with b, in every kind of monomial.
POLYNOMIAL_LENS = {
    "name": "Polynomial singlet",
    "surfaces": {
        "1": {"type": "conic", "radius": 40.0, "conic": -0.5, "semi_diameter": 9.0,
              "thickness": 5.0, "material": "1.5168/64.17"},
        "2": {"type": "xy_polynomial", "x2": -0.008, "y2": -0.007, "xy": 1e-3, "x3": 2e-5,
              "x2y": -3e-5, "xy2": 1e-5, "y3": 4e-5, "b": 0.03, "semi_diameter": 9.0,
              "material": "air"},
    },
    "sensor": {"distance": 45.0},
}  # fmt: skip


@pytest.fixture(params=["asphere", "cooke_triplet", "wavefront_coding", "polynomial"])
def bent_lens(request, root):
    """A float64 lens in which no parameter is so special that its gradient would vanish."""
    if request.param == "polynomial":
        return lens_from_prescription(POLYNOMIAL_LENS)
    lens = load_lens(root / "conf" / "lens" / f"{request.param}.yaml")
    if request.param == "wavefront_coding":
        with torch.no_grad():
            plate = {"x3": 1e-4, "x2y": -2e-5, "xy2": 3e-5, "y3": 8e-5}
            for name, value in plate.items():
                lens.variables([f"surfaces.5.{name}"])[f"surfaces.5.{name}"].fill_(value)
    return lens


@pytest.fixture
def bundle():
    """Rays that a lens lets through: a skew pencil about its stop, from a finite source."""

    def make(lens, fill=0.5, count=7, depth=300.0, wavelength=550.0):
        pupil = lens.first_order(wavelength).entrance_pupil
        z, radius = float(pupil.z.detach()), 0.5 * fill * float(pupil.diameter.detach())
        angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count) + 0.3
        scale = torch.linspace(0.3, 1.0, count, dtype=torch.float64) * radius
        target = torch.stack(
            (scale * torch.cos(angle), scale * torch.sin(angle), torch.full_like(angle, z)), -1
        )
        source = torch.tensor([0.02 * depth, -0.03 * depth, -depth], dtype=torch.float64)
        direction = target - source
        direction = direction / direction.norm(dim=-1, keepdim=True)
        return Rays(source.expand(count, 3), direction, wavelength)

    return make


@pytest.fixture
def registered():
    """Register surface classes for one test."""
    kinds = []

    def register(shape):
        dolens.register_surface(shape)
        kinds.append(shape.kind)
        return shape

    yield register
    for kind in kinds:
        unregister_surface(kind)
