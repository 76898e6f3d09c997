"""The vergence of light at an ideal lens, where the lens in front has no paraxial curvature."""

import math

import pytest
import torch

from dolens import Rays
from dolens.prescriptions import lens_from_prescription

F64 = torch.float64


def test_behind_an_axicon_an_ideal_lens_focuses_into_a_ring_with_equal_paths(backend):
    """The cone turns light along the axis to a plane wave in each half of the plane y = 0."""
    surfaces = {
        "1": {"type": "plane", "semi_diameter": 5.0, "thickness": 2.0, "material": "1.5"},
        "2": {"type": "odd_asphere", "radius": math.inf, "a1": -0.1, "semi_diameter": 5.0,
              "thickness": 10.0, "material": "air"},
        "3": {"type": "paraxial_lens", "focal_length": 50.0, "semi_diameter": 9.0,
              "material": "air"},
    }  # fmt: skip
    lens = lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 50.0}})
    position = torch.tensor([[x, 0.0, -1.0] for x in (1.0, 2.0, 4.5)], dtype=F64)
    hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=F64)))
    assert bool(hit.valid.all())
    base = math.atan(0.1)
    ring = -50.0 * math.tan(math.asin(1.5 * math.sin(base)) - base)
    assert hit.position[:, 0].tolist() == pytest.approx([ring] * 3, rel=1e-13)
    assert (hit.path_length - hit.path_length[0]).abs().max() < 1e-12
    gradients = torch.autograd.grad(
        hit.path_length.sum(), list(lens.parameters()), allow_unused=True
    )
    assert all(g is None or bool(g.isfinite().all()) for g in gradients)
