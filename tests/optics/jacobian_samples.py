"""Lenses and rays that Jacobians and least squares are tested with."""

import torch
import yaml

from dolens import Rays, load_lens
from dolens.prescriptions import lens_from_prescription

ALL = ("x", "y", "path_length")
EVERY = ["surfaces.*", "thicknesses.*", "sensor_distance"]


def posed_triplet(root):
    """A Cooke triplet of three elements out of place; the second lies within a moved group."""
    text = (root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8")
    elements = {
        "front": {"surfaces": [1, 2], "tilt_x": 0.5, "decenter_y": 0.1, "pivot": [0.0, 0.2, 1.0]},
        "group": {"surfaces": [3, 6], "tilt_y": -0.4, "tilt_z": 3.0, "shift_z": 0.05},
        "inner": {"surfaces": [3, 4], "tilt_x": 0.3, "pivot": [-0.4, 0.0, 0.0]},
    }
    return lens_from_prescription(yaml.safe_load(text) | {"elements": elements})


def freeform():
    """A singlet with a B-spline back of 7×6 coefficients, of which a pencil meets a few."""
    row = [-0.01 * (3 * (i - 2.4) ** 2 + i) for i in range(6)]
    spline = {
        "type": "b_spline", "half_width": 10.0, "semi_diameter": 9.0, "material": "air",
        "coefficients": [[h - 0.02 * (j - 3.1) ** 2 for h in row] for j in range(7)],
    }  # fmt: skip
    front = {
        "type": "conic", "radius": 40.0, "conic": -0.4, "semi_diameter": 9.0, "thickness": 5.0,
        "material": "1.5168/64.17",
    }  # fmt: skip
    return lens_from_prescription(
        {"surfaces": {"1": front, "2": spline}, "sensor": {"distance": 45.0}}
    )


def sample_lens(name, root):
    """A lens with aspheric coefficients, one with poses, or one with spline coefficients."""
    if name == "posed":
        return posed_triplet(root)
    if name == "freeform":
        return freeform()
    return load_lens(root / "conf/lens/asphere.yaml")


def wide_bundle(lens, count=300, dtype=torch.float64, wavelengths=(486.1, 587.6, 656.3)):
    """Rays of three wavelengths over more than the lens lets through, skew to its axis."""
    radius = 1.15 * lens.surfaces["1"].semi_diameter
    generator = torch.Generator().manual_seed(3)
    start = 2.0 * torch.rand((count, 3), generator=generator, dtype=torch.float64) - 1.0
    position = start * torch.tensor([radius, radius, 0.0]).double() + torch.tensor([0, 0, -3.0])
    direction = torch.tensor([0.03, -0.05, 1.0]).double().expand(count, 3)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    wavelength = torch.tensor(wavelengths).double()[torch.arange(count) % len(wavelengths)]
    return Rays(position.to(dtype), direction.to(dtype), wavelength)
