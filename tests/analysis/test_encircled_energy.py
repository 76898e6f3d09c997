"""Geometric encircled energy, against closed forms."""

import numpy as np
import pytest
import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.encircled_energy import encircled_energy
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription


@pytest.fixture(scope="module")
def stop():
    """A stop alone: parallel light makes a uniform disc of its own size on the sensor."""
    plane = {"type": "plane", "material": "air", "semi_diameter": 0.01}
    return lens_from_prescription(
        {
            "surfaces": {"1": {**plane, "thickness": 1.0}, "2": {**plane, "semi_diameter": 0.5}},
            "sensor": {"distance": 20.0},
        }
    )


def test_a_uniform_disc_holds_light_as_the_square_of_the_radius(stop):
    radii = np.linspace(0.0, 12.0, 13)
    found = encircled_energy(
        stop, conditions(stop, [(0.0, 0.0), (0.0, 5.0)], [500.0, 600.0]), radii
    )
    expected = np.minimum(radii / 10.0, 1.0) ** 2
    np.testing.assert_allclose(found.energy[0], expected, atol=2e-3)
    # From (0, 5°) the disc is the same, about its own centroid.
    np.testing.assert_allclose(found.energy[1], expected, atol=2e-3)
    assert found.radius_um(0.25).tolist() == pytest.approx([5.0, 5.0], abs=0.1)
    assert found.diffraction == (False, False)


def test_lateral_shifts_between_wavelengths_count(stop):
    """Half of the weight each, of spots that coincide, is the same as one."""
    radii = [2.0, 6.0]
    both = encircled_energy(
        stop, conditions(stop, [(0.0, 0.0)], [500.0, 600.0], wavelength_weights=(3, 1)), radii
    )
    one = encircled_energy(stop, conditions(stop, [(0.0, 0.0)], [500.0]), radii)
    assert torch.allclose(both.energy, one.energy)


def test_fields_without_light_are_nan(stop):
    found = encircled_energy(stop, conditions(stop, [(0.0, 0.0), (0.0, 80.0)], [500.0]), rays=400)
    assert torch.isnan(found.energy[1]).all() and float(found.energy[0, -1]) == pytest.approx(1.0)
    assert torch.isnan(found.radius_um(0.5)).tolist() == [False, True]
    for wrong in ([], [1.0, 1.0], [-1.0, 2.0]):
        with pytest.raises(InputError, match="radii"):
            encircled_energy(stop, conditions(stop, [(0.0, 0.0)], [500.0]), wrong, rays=4)
