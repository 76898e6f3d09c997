"""Gaussian beams through lenses, and what of them enters a fibre, beside closed forms."""

import math

import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.gaussian_beams import coupled_light, fibre_coupling, gaussian_beam
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription

NM = 1550.0
RADIUS = 0.0052  # mm, of a standard single-mode fibre at 1550 nm
RANGE = math.pi * RADIUS**2 / (NM * 1e-6)  # Rayleigh range, mm


def relay(distance=20.0, image=20.0, focal_length=10.0, semi_diameter=8.0):
    """An ideal lens between two fibres."""
    return lens_from_prescription(
        {
            "name": "relay",
            "stop": 1,
            "wavelengths": [NM],
            "object_distance": distance,
            "surfaces": {
                1: {
                    "type": "paraxial_lens",
                    "focal_length": focal_length,
                    "semi_diameter": semi_diameter,
                    "material": "air",
                }
            },
            "sensor": {"distance": image, "diameter": 1.0},
        },
        dtype=torch.float64,
    )


def coupling(lens, source=RADIUS, **settings):
    where = conditions(lens, fields=0, wavelengths=NM)
    return fibre_coupling(lens, where, source, **settings)


def test_a_relay_of_unit_magnification_couples_all_light():
    """Up to the ideal lens's own sine condition, of the fourth power of the aperture 0.095."""
    found = coupling(relay())
    assert float(found.coupling) == pytest.approx(1.0, abs=1e-4)
    assert float(found.system) == pytest.approx(1.0, abs=1e-6)
    assert float(found.sampling_error) < 1e-5


def test_modes_of_other_size_overlap_less():
    """η = (2·w₁·w₂/(w₁² + w₂²))²."""
    for ratio in (0.5, 1.5, 3.0):
        expected = (2.0 * ratio / (1.0 + ratio**2)) ** 2
        found = coupling(relay(), fibre=ratio * RADIUS)
        assert float(found.coupling) == pytest.approx(expected, abs=3e-4)


def test_a_magnified_fibre_takes_the_magnified_mode():
    """At 30 and 15 mm from a lens of 10 mm the image is half as large."""
    found = coupling(relay(30.0, 15.0), source=2.0 * RADIUS, fibre=RADIUS)
    assert float(found.coupling) == pytest.approx(1.0, abs=3e-4)


@pytest.mark.parametrize("offset", [(0.002, 0.0), (0.0, -0.005), (0.003, 0.004)])
def test_a_fibre_that_stands_aside_takes_less(offset):
    """η = exp(-d²/w²)."""
    found = coupling(relay(), position=offset)
    expected = math.exp(-((math.hypot(*offset) / RADIUS) ** 2))
    assert float(found.coupling) == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("tilt", [(1.0, 0.0), (0.0, -3.0)])
def test_a_fibre_that_is_tilted_takes_less(tilt):
    """η = exp(-(π·w·sin θ/λ)²)."""
    found = coupling(relay(), tilt=tilt)
    sine = math.sin(math.radians(math.hypot(*tilt)))
    expected = math.exp(-((math.pi * RADIUS * sine / (NM * 1e-6)) ** 2))
    assert float(found.coupling) == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("step", [0.02, -0.05, 0.1])
def test_a_fibre_out_of_focus_takes_less(step):
    """η = 1/(1 + (z/2z_R)²)."""
    found = coupling(relay(image=20.0 + step))
    expected = 1.0 / (1.0 + (step / (2.0 * RANGE)) ** 2)
    assert float(found.coupling) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("share", [0.7, 1.0, 1.5])
def test_a_stop_clips_source_and_mode(share):
    """Seen under the angle θ it passes 1 - exp(-2·sin²θ/s²), and the square of it is coupled."""
    spread = NM * 1e-6 / (math.pi * RADIUS)
    edge = share * 20.0 * spread
    found = coupling(relay(semi_diameter=edge))
    passed = 1.0 - math.exp(-2.0 * (math.sin(math.atan(edge / 20.0)) / spread) ** 2)
    assert float(found.system) == pytest.approx(passed, abs=1e-4)
    assert float(found.coupling) == pytest.approx(passed**2, abs=3e-4)


def hyperboloid(focal_length, thickness, semi_diameter):
    """A stigmatic lens of index 1.5, its plane in front: K = -n², R = -f·(n - 1)."""
    index = 1.5
    back = {"type": "conic", "radius": -focal_length * (index - 1.0), "conic": -(index**2)}
    return lens_from_prescription(
        {
            "name": "hyperboloid",
            "stop": 1,
            "wavelengths": [NM],
            "surfaces": {
                1: {
                    "type": "plane",
                    "semi_diameter": semi_diameter,
                    "thickness": thickness,
                    "material": index,
                },
                2: {**back, "semi_diameter": semi_diameter, "material": "air"},
            },
            "sensor": {"distance": focal_length, "diameter": 1.0},
        },
        dtype=torch.float64,
    )


def test_a_collimated_beam_enters_the_fibre_that_matches_its_focus():
    """w' = λ·f/(π·w)."""
    lens = hyperboloid(10.0, 3.0, 4.0)
    beam = 0.5
    fibre = NM * 1e-6 * 10.0 / (math.pi * beam)
    found = coupling(lens, source=beam, fibre=fibre)
    assert float(found.coupling) == pytest.approx(1.0, abs=1e-4)
    bare = coupling(lens.coated("none"), source=beam, fibre=fibre)
    assert float(bare.coupling) == pytest.approx(0.96**2, abs=1e-3)
    assert float(bare.receiver) == pytest.approx(1.0, abs=1e-3)
    # (2·2/(1 + 4))², but for the lens's departure from the sine condition.
    wider = coupling(lens, source=beam, fibre=2.0 * fibre)
    assert float(wider.coupling) == pytest.approx(0.64, abs=2e-3)


@pytest.mark.parametrize(("beam", "printed"), [(2.0, 0.999955), (1.5, 0.924587)])
def test_zemax_s_sample_couples_what_its_physical_optics_print(beam, printed):
    """Its Fiber Coupling, 1 µm, a fibre of 8 µm; printed in a notebook of PyZDDE (2014)."""
    lens = hyperboloid(50.0, 10.0, 8.0)
    where = conditions(lens, fields=0, wavelengths=1000.0)
    found = fibre_coupling(lens, where, beam, fibre=0.008)
    # What they differ by is the lens's departure from the sine condition, half of the square of
    # the beam's slope.
    assert float(found.coupling) == pytest.approx(printed, abs=1.5e-3)


def test_the_derivatives_are_those_of_differences():
    lens = relay(image=20.03)
    point = ObjectPoints.at([[0.0, 0.0, -20.0]])
    waves = torch.tensor([NM], dtype=torch.float64)

    def coupled(distance, source, fibre):
        system = lens.system({"sensor_distance": distance})
        return coupled_light(system, point, waves, source, fibre, samples=24)[0]

    given = [torch.tensor(v, dtype=torch.float64) for v in (20.03, 0.005, 0.006)]
    given = [value.requires_grad_() for value in given]
    torch.autograd.gradcheck(coupled, given, eps=1e-6, atol=1e-5)


def test_a_beam_is_focused_as_self_says():
    """Self, Appl. Opt. 22, 658 (1983): 1/(s + z_R²/(s - f)) + 1/s' = 1/f, and the waist
    w·f/√((s - f)² + z_R²).
    """
    waist, f, s = 0.05, 10.0, 25.0
    rayleigh = math.pi * waist**2 / (NM * 1e-6)
    beam = gaussian_beam(relay(focal_length=f), waist, -s, NM)
    lens, sensor = beam.rows
    image = 1.0 / (1.0 / f - 1.0 / (s + rayleigh**2 / (s - f)))
    assert lens.waist_z == pytest.approx(image, rel=1e-12)
    assert lens.waist == pytest.approx(waist * f / math.hypot(s - f, rayleigh), rel=1e-12)
    assert lens.radius == pytest.approx(waist * math.hypot(1.0, s / rayleigh), rel=1e-12)
    assert sensor.waist_z == pytest.approx(image - 20.0, rel=1e-12)
    assert sensor.radius == pytest.approx(
        lens.waist * math.hypot(1.0, (20.0 - image) / lens.rayleigh), rel=1e-12
    )


def test_in_glass_a_beam_s_rayleigh_range_is_longer():
    """A plane face keeps the waist, and moves it by the index; a mirror folds the beam."""
    window = load_lens("coated_window")
    row = gaussian_beam(window, 0.1, 0.0, 587.56).rows[0]
    index = float(window.materials[1].index(587.56))
    assert row.waist == pytest.approx(0.1, rel=1e-12)
    assert row.rayleigh == pytest.approx(index * math.pi * 0.01 / 587.56e-6, rel=1e-12)


def test_m_squared_widens_the_far_field():
    lens = relay()
    first, third = (gaussian_beam(lens, 0.05, -500.0, NM, m).rows[0].radius for m in (1.0, 3.0))
    assert third == pytest.approx(3.0 * first, rel=1e-2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"source": 0.0}, "source: 0; a mode radius must be positive"),
        ({"fibre": -1.0}, "fibre: -1; a mode radius must be positive"),
    ],
)
def test_impossible_fibres_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        coupling(relay(), **settings)


def test_a_collimated_beam_needs_a_fibre():
    lens = load_lens("cooke_triplet")
    where = conditions(lens, fields=0, wavelengths=587.56)
    with pytest.raises(InputError, match="fibre: missing"):
        fibre_coupling(lens, where, 1.0)
    for name, given in (("waist", {"waist": 0.0}), ("m_squared", {"waist": 1.0, "m_squared": 0.5})):
        with pytest.raises(InputError, match=name):
            gaussian_beam(lens, **given)
