"""The lenses of the benchmark and the rays that go through them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

import dolens
from dolens import Lens, Rays
from dolens.prescriptions import lens_from_prescription

ROOT = Path(__file__).resolve().parents[2]
WAVELENGTH = 587.5618
# Half fields in degrees: rays come from the square between the axis and it, so that the gradients
# of odd terms do not cancel.
HALF_FIELD = {
    "cooke_triplet": 14.0,
    "nikon": 20.0,
    "wavefront_coding": 0.4,
    "large_fov_doublet": 14.0,
}
LENSES = tuple(HALF_FIELD)
CUBIC = 1e-4  # of the phase plate's x³ and y³, as in the reference rays

# One freeform surface, to time it alone; 16×16 coefficients.
_SPLINE_SIZE, _SPLINE_HALF_WIDTH = 16, 6.0
HALF_FIELD["b_spline"] = 5.0
_DISC = {"normalization_radius": 5.0}
_WAVES = [[1e-4 * math.cos(0.7 * i) * math.sin(0.5 * j) for i in range(33)] for j in range(33)]
# Biconvex lenses of two surfaces of a kind, to time that kind: shape of surface 1; surface 2 has
# radii of opposite sign.
SINGLETS: dict[str, dict] = {
    "singlet_even_asphere": {"radius": 20.0, "conic": -0.5, "a4": 1e-6, "a6": 1e-9, "a8": 1e-11},
    "singlet_sphere": {"radius": 20.0},
    "singlet_odd_asphere": {"radius": 20.0, "conic": -0.5, "a3": 1e-5, "a4": 1e-6, "a5": 1e-8},
    "singlet_biconic": {"radius_x": 20.0, "radius_y": 22.0, "conic_x": -0.5, "conic_y": 0.1},
    "singlet_toroid": {"radius_x": 20.0, "radius_y": 22.0, "conic_y": 0.1, "a4": 1e-6},
    "singlet_zernike_fringe": _DISC
    | {"radius": 20.0, "z4": 1e-3, "z9": 1e-4, "z5": 2e-4, "z8": 1e-4},
    "singlet_zernike_standard": _DISC
    | {"radius": 20.0, **{f"z{j}": 1e-4 / j for j in range(4, 38)}},
    "singlet_q_con": {"radius": 20.0, **{f"q{m}": 1e-3 / (m + 1) for m in range(6)}, **_DISC},
    "singlet_q_bfs": {"radius": 20.0, **{f"q{m}": 1e-3 / (m + 1) for m in range(6)}, **_DISC},
    "singlet_grid_sag": {"radius": 20.0, "sag": _WAVES, "spacing_x": 0.4, "spacing_y": 0.4},
}
HALF_FIELD |= dict.fromkeys(SINGLETS, 5.0)
HALF_FIELD["asphere"] = 0.5


@dataclass(frozen=True)
class Case:
    """A lens and rays through it, both of one precision.

    Attributes:
        name: of the lens.
        lens: its `backend` says who traces.
        rays: (N, 3), made once.
    """

    name: str
    lens: Lens
    rays: Rays

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.rays.position.shape[0]

    @property
    def surfaces(self) -> int:
        """Number of surfaces; the sensor is not counted."""
        return len(self.lens.surfaces)


def load(name: str, dtype: torch.dtype, backend: str, device: torch.device) -> Lens:
    """A lens of the benchmark."""
    if name == "b_spline":
        lens = lens_from_prescription(_spline_prescription(), dtype)
    elif name in SINGLETS:
        lens = lens_from_prescription(_singlet_prescription(name), dtype)
    else:
        lens = dolens.load_lens(ROOT / "conf" / "lens" / f"{name}.yaml", dtype=dtype)
    if name == "wavefront_coding":
        with torch.no_grad():
            lens.surfaces["5"].x3.fill_(CUBIC)
            lens.surfaces["5"].y3.fill_(CUBIC)
    lens.backend = backend
    return lens.to(device)


def make_rays(name: str, count: int, dtype: torch.dtype, device: torch.device) -> Rays:
    """Parallel beams of random fields, random over the entrance pupil; the same for every run.

    They start one semi-diameter in front of surface 1.  In float32 they are the float64 ones,
    rounded.
    """
    lens = load(name, torch.float64, "reference", torch.device("cpu"))
    with torch.no_grad():
        pupil = lens.first_order(WAVELENGTH).entrance_pupil
    generator = torch.Generator().manual_seed(20)
    u = torch.rand((4, count), generator=generator, dtype=torch.float64)
    half_field = math.tan(math.radians(HALF_FIELD[name]))
    direction = torch.stack((u[0] * half_field, u[1] * half_field, torch.ones_like(u[0])), -1)
    radius, angle = 0.5 * float(pupil.diameter) * u[2].sqrt(), 2 * math.pi * u[3]
    z = torch.full_like(radius, float(pupil.z))
    start = -lens.system().surfaces[0].semi_diameter
    at_pupil = torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1)
    position = at_pupil + (start - float(pupil.z)) * direction
    direction = direction / direction.norm(dim=-1, keepdim=True)
    options = {"dtype": dtype, "device": device}
    return Rays(position.to(**options), direction.to(**options), WAVELENGTH)


def part_of(rays: Rays, first: int, last: int) -> Rays:
    """Rays `first` to `last` of a bundle (N, 3)."""
    return Rays(rays.position[first:last], rays.direction[first:last], rays.wavelength)


def chunks(rays: Rays, size: int) -> Iterator[Rays]:
    """A bundle (N, 3) in pieces."""
    for first in range(0, rays.position.shape[0], size):
        yield part_of(rays, first, first + size)


def _singlet_prescription(name: str) -> dict:
    front = SINGLETS[name]
    back = {key: -value if key.startswith("radius") else value for key, value in front.items()}
    common = {"type": name.removeprefix("singlet_"), "semi_diameter": 5.0}
    surfaces = {
        "1": {**common, **front, "thickness": 3.0, "material": "1.5168/64.17"},
        "2": {**common, **back, "material": "air"},
    }
    return {"name": name, "surfaces": surfaces, "stop": 1, "sensor": {"distance": 19.0}}


def _spline_prescription() -> dict:
    """A weak freeform front on glass, the sensor inside the glass."""
    n, half = _SPLINE_SIZE, _SPLINE_HALF_WIDTH
    place = torch.linspace(-half, half, n, dtype=torch.float64)
    x, y = place[None, :], place[:, None]
    sag = (x**2 + y**2) / 60.0 + 1e-4 * x**3 + 5e-5 * x * y**2
    return {
        "name": "B-spline front",
        "surfaces": {
            "1": {
                "type": "b_spline",
                "coefficients": sag.tolist(),
                "half_width": half,
                "semi_diameter": 5.0,
                "material": "1.5168/64.17",
            }
        },
        "sensor": {"distance": 60.0},
    }
