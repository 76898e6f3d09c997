"""A lens that is made may have another index than its drawing, and surfaces out of round."""

import math

import pytest
import torch

from dolens import InputError, Rays, load_lens
from dolens.optics.fabrication_errors import fabrication_errors
from dolens.optics.paraxial import first_order
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.surfaces.zernike import ZernikeFringe
from dolens.prescriptions.build import lens_from_prescription

BACKENDS = ("reference", "cpu")


def number(value):
    return torch.tensor(value, dtype=torch.float64)


def singlet(index="1.5", **back):
    return lens_from_prescription(
        {
            "name": "singlet",
            "stop": 1,
            "wavelengths": [550.0],
            "surfaces": {
                "1": {
                    **{"type": "sphere", "radius": 50.0, "semi_diameter": 8.0},
                    **{"thickness": 4.0, "material": index},
                },
                "2": {
                    **{"type": "even_asphere", "radius": -80.0, "conic": -0.5, "a4": 1e-6},
                    **{"semi_diameter": 8.0, "material": "air"},
                    **back,
                },
            },
            "sensor": {"distance": 60.0, "diameter": 10.0},
        }
    )


def rays(count=60, spread=6.0):
    generator = torch.Generator().manual_seed(2)
    xy = spread * (torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5) * 2.0
    position = torch.cat([xy / 1.5, torch.full((count, 1), -5.0, dtype=torch.float64)], -1)
    direction = torch.tensor([0.05, -0.02, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(count, 3)
    return Rays(position, direction, torch.tensor(550.0, dtype=torch.float64))


def landed(lens, values, backend):
    hit = trace_rays(lens.system(values).traced_by(backend), rays())
    assert bool(hit.valid.all())
    return hit.position[..., :2]


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_index_offset_is_another_glass(backend):
    lens, other = (singlet(n).requires_grad_(False) for n in ("1.5", "1.507"))
    values = {"media.1.index_offset": number(0.007)}
    torch.testing.assert_close(
        landed(lens, values, backend), landed(other, None, backend), rtol=0.0, atol=1e-12
    )
    assert (landed(lens, values, backend) - landed(lens, None, backend)).abs().max() > 1e-3
    made, drawn = lens.system(values), other.system()
    assert float(first_order(made, 550.0).efl) == pytest.approx(
        float(first_order(drawn, 550.0).efl)
    )
    for system in (made, drawn):
        assert ParaxialNumbers.of(system).exit_pupil(550.0) == pytest.approx(
            ParaxialNumbers.of(drawn).exit_pupil(550.0), rel=1e-12
        )


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "even_asphere", "radius": -80.0, "conic": -0.5, "a4": 1e-6},
        {"type": "conic", "radius": -80.0, "conic": -0.5},
        {"type": "sphere", "radius": -80.0},
        {"type": "plane"},
        {"type": "xy_polynomial", "x2": -0.006, "y2": -0.006, "x3": 1e-5},
    ],
)
def test_astigmatism_is_added_to_the_sag(shape):
    lens = lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": {
                    "type": "sphere",
                    "radius": 50.0,
                    "semi_diameter": 8.0,
                    "thickness": 4.0,
                    "material": "1.5",
                },
                "2": {**shape, "semi_diameter": 7.0, "material": "air"},
            },
            "sensor": {"distance": 60.0},
        }
    )
    lens.requires_grad_(False)
    a, b = 3e-4, -2e-4
    values = {"surfaces.2.astigmatism_0": number(a), "surfaces.2.astigmatism_45": number(b)}
    radius, angle = torch.meshgrid(
        torch.linspace(0.0, 7.0, 5, dtype=torch.float64),
        torch.linspace(0.0, 6.0, 9, dtype=torch.float64),
        indexing="ij",
    )
    x, y = radius * angle.cos(), radius * angle.sin()
    sags = []
    for system in (lens.system(), lens.system(values)):
        surface = system.surfaces[1]
        sags.append(surface.shape.sag_and_gradient(surface.parameters, x, y)[0])
    # In polar coordinates: cos 2φ and sin 2φ, which are 1 at the edge.
    wanted = (radius / 7.0) ** 2 * (a * (2.0 * angle).cos() + b * (2.0 * angle).sin())
    torch.testing.assert_close(sags[1] - sags[0], wanted, rtol=0.0, atol=1e-15)
    assert float((sags[1] - sags[0]).max()) == pytest.approx(math.hypot(a, b), rel=0.1)


@pytest.mark.parametrize("backend", BACKENDS)
def test_rays_have_the_derivatives_of_departures(backend):
    lens = singlet()
    lens.requires_grad_(False)
    names = list(fabrication_errors(lens))
    assert names == [
        *("surfaces.1.astigmatism_0", "surfaces.1.astigmatism_45"),
        *("surfaces.2.astigmatism_0", "surfaces.2.astigmatism_45"),
        "media.1.index_offset",
    ]
    at = torch.tensor([1e-3, -2e-3, 5e-4, 1e-3, 2e-3], dtype=torch.float64)
    weight = torch.rand(60, 2, generator=torch.Generator().manual_seed(3)).double()

    def total(numbers):
        values = dict(zip(names, numbers.unbind(), strict=True))
        return (weight * landed(lens, values, backend)).sum()

    start = at.clone().requires_grad_()
    (found,) = torch.autograd.grad(total(start), start)
    for column in range(len(names)):
        step = torch.zeros_like(at)
        step[column] = 1e-6
        difference = (total(at + step) - total(at - step)) / 2e-6
        assert float(found[column]) == pytest.approx(float(difference), rel=1e-6), names[column]


def test_what_is_no_glass_has_no_index_offset(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    media = [name for name in fabrication_errors(lens) if name.startswith("media")]
    assert media == ["media.1.index_offset", "media.3.index_offset", "media.5.index_offset"]
    with pytest.raises(InputError, match=r"no parameter 'media\.2\.index_offset'"):
        lens.system({"media.2.index_offset": number(1e-3)})


def test_light_that_a_mirror_returns_is_in_the_same_glass(root):
    lens = load_lens(root / "conf/lens/published/mangin_reflex_us3507556_e1.yaml")
    names = [name for name in fabrication_errors(lens) if name.startswith("media")]
    values = {name: number(1e-4 * (i + 1)) for i, name in enumerate(names)}
    system = lens.system(values)
    for mirror in system.mirrors:
        assert system.index_offsets[mirror] is system.index_offsets[mirror - 1]
    wave = lens.primary_wavelength
    shifts = [
        float(a) - float(b)
        for a, b in zip(system.indices(wave), lens.system().indices(wave), strict=True)
    ]
    assert sum(shift != 0.0 for shift in shifts) > len(names)


def test_an_irregular_surface_is_a_zernike_surface_in_all_but_speed():
    lens = singlet().requires_grad_(False)
    values = {"surfaces.2.astigmatism_0": number(3e-4), "surfaces.2.astigmatism_45": number(2e-4)}
    surface = lens.system(values).surfaces[1]
    own, known = surface.parameters, ZernikeFringe
    assert issubclass(surface.shape, known) and surface.shape is not known
    x, y = torch.linspace(-6.0, 6.0, 7).double(), torch.linspace(5.0, -4.0, 7).double()
    sags = (shape.sag_and_gradient(own, x, y)[:3] for shape in (surface.shape, known))
    for found, expected in zip(*sags, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-18)
    for name in ("paraxial_curvature", "fourth_order_departure"):
        found, expected = (getattr(shape, name)(own) for shape in (surface.shape, known))
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=0.0)
