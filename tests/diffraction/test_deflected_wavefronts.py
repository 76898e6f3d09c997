"""Wavefronts behind diffractive lenses, gratings and ideal lenses."""

import math

import pytest
import torch

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.prescriptions import lens_from_prescription

WAVE = 500.0


def lens_of(*rows, distance, **more):
    rows = [{"semi_diameter": 4.0, "material": "air", **row} for row in rows]
    surfaces = {str(i): row for i, row in enumerate(rows, 1)}
    lens = lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": distance}, **more})
    return lens.requires_grad_(False)


def zone_plate(focus, radius=4.0, terms=20):
    """The phase -2π/λ·(√(r² + f²) - f) as a polynomial in r/R."""
    row, binomial = {"type": "radial", "norm_radius": radius}, 1.0
    for k in range(1, terms + 1):
        binomial *= (1.5 - k) / k
        path = binomial * radius ** (2 * k) * focus ** (1 - 2 * k)
        row[f"p{2 * k}"] = -2.0 * math.pi / (WAVE * 1e-6) * path
    return row


def worst(found):
    """Largest |OPD| of rays that pass, mm."""
    return float((found.opd.abs() * (found.coverage > 0.0)).max())


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_an_ideal_zone_plate_has_a_strehl_ratio_of_one(backend):
    lens = lens_of({"type": "plane", "phase": zone_plate(20.0)}, distance=20.0)
    axis = ObjectPoints.at_infinity([[0.0, 0.0]])
    found = pupil_wavefront(lens.system().traced_by(backend), axis, WAVE, [[0.0, 0.0]], 48)
    assert worst(found) < 1e-12
    assert float(found.strehl_ratio) == pytest.approx(1.0, abs=1e-12)
    other = pupil_wavefront(lens.system().traced_by(backend), axis, 505.0, [[0.0, 0.0]], 48)
    assert float(other.strehl_ratio) < 0.1


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_an_ideal_lens_has_a_spherical_wavefront_for_every_field(backend):
    lens = lens_of({"type": "paraxial_lens", "focal_length": 20.0}, distance=20.0)
    fields = [[0.0, 0.0], [12.0, -5.0], [25.0, 20.0]]
    points = ObjectPoints.at_infinity(fields)
    centres = [[20.0 * math.tan(math.radians(a)) for a in field] for field in fields]
    found = pupil_wavefront(lens.system().traced_by(backend), points, WAVE, centres, 32)
    assert worst(found) < 1e-12


def test_points_of_several_distances_have_conjugates_of_their_own():
    """Those whose images are the centres have none of the others' aberration."""
    lens = lens_of({"type": "paraxial_lens", "focal_length": 20.0}, distance=25.0)
    points = ObjectPoints.at([[3.0, -8.0, -100.0], [0.0, 0.0, -100.0], [0.0, 0.0, -104.0]])
    centres = [[-0.75, 2.0], [0.0, 0.0], [0.0, 0.0]]
    found = pupil_wavefront(lens.system(), points, WAVE, centres, 32)
    size = (found.opd.abs() * (found.coverage > 0.0)).amax((-2, -1))
    assert size[:2].max() < 1e-12
    alone = pupil_wavefront(lens.system(), points[torch.tensor([2])], WAVE, centres[2:], 32)
    assert worst(alone) > 1e-3
    assert (found.opd[2] - alone.opd[0]).abs().max() < 1e-13


def test_a_grating_leaves_a_plane_wave_that_an_ideal_lens_focuses():
    """A hybrid of all three: a tilted plane wave of its own wavelength comes to one point."""
    lens = lens_of(
        {"type": "plane", "thickness": 3.0, "phase": {"type": "grating", "grooves": 400.0}},
        {"type": "paraxial_lens", "focal_length": 30.0, "semi_diameter": 9.0},
        distance=30.0,
    )
    sine = 400.0 * WAVE * 1e-6
    centre = [[0.0, 30.0 * sine / math.sqrt(1.0 - sine * sine)]]
    axis = ObjectPoints.at_infinity([[0.0, 0.0]])
    found = pupil_wavefront(lens.system(), axis, WAVE, centre, 32)
    assert bool(torch.isfinite(found.opd).all())
    assert worst(found) < 1e-12
