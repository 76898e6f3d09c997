"""Cells of a metasurface as data: what a table says between its nodes, and widths for a phase."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from dolens.errors import InputError
from dolens.optics.diffractive import lens_phase
from dolens.optics.metasurface import CellTable
from dolens.prescriptions.cells import cell_widths
from tests.optics.nanopillars import FILMS, effective, interpolated, rigorous, table_of


def resonant(width, wavelength):
    """A resonance that is critically coupled at one width: there t is zero, and its phase winds."""
    tuned = (wavelength - 550 - 0.6 * (width - 140)) / 20
    lossy = (width - 140) / 80
    return (tuned + 1j * lossy) / (tuned + 1j) * np.exp(1.8j * np.pi * width / 100)


def splines_of(values, table, widths, wavelengths):
    return CubicSpline(table.widths, CubicSpline(table.wavelengths, values)(wavelengths), axis=1)(
        widths
    )


def errors(passed, widths, wavelengths):
    """Largest errors between nodes: ours, of complex numbers alone, and of unwrapped phases."""
    table = table_of(passed, widths, wavelengths)
    at = np.linspace(widths[0], widths[-1], 41), np.linspace(wavelengths[0], wavelengths[-1], 23)
    exact = np.array([[passed(w, nm) for w in at[0]] for nm in at[1]])
    plain = splines_of(table.amplitude * np.exp(1j * table.phase), table, *at)
    phase = np.unwrap(table.phase, axis=1)
    phase = phase + (np.unwrap(phase[:, 0]) - phase[:, 0])[:, None]
    apart = splines_of(table.amplitude, table, *at) * np.exp(1j * splines_of(phase, table, *at))
    return [np.abs(found - exact).max() for found in (interpolated(table, *at), plain, apart)]


def test_rigorous_ridges_that_are_fine_enough_are_a_film():
    for width in (4.0, 10.0, 16.0):
        exact = rigorous(width, 532.0, pitch=20.0, height=600.0)
        assert exact == pytest.approx(effective(width, 532.0, 20.0, 600.0), abs=0.02)


def test_a_table_that_is_smooth_needs_no_unwrapped_phase():
    ours, plain, apart = errors(effective, np.linspace(60, 220, 29), np.linspace(460, 640, 15))
    assert ours < 0.01
    assert ours < 0.4 * plain
    assert ours < 1.3 * apart


def test_rigorous_ridges_are_interpolated_better_than_by_complex_numbers_alone():
    ours, plain, _ = errors(rigorous, np.linspace(40, 180, 14), np.linspace(500, 640, 9))
    assert ours < 0.05
    assert ours < 0.4 * plain


def test_a_resonance_whose_phase_winds_does_not_break_a_table():
    ours, plain, apart = errors(resonant, np.linspace(60, 220, 24), np.linspace(450, 650, 16))
    assert ours < 0.6 * plain < 0.05
    assert apart > 1.0


def test_derivatives_are_those_of_the_interpolated_table():
    widths = torch.tensor([61.0, 95.0, 140.0, 229.5], dtype=torch.float64, requires_grad=True)

    def parts(w):
        return torch.view_as_real(FILMS.transmission(w, 533.0))

    assert torch.autograd.gradcheck(parts, (widths,))
    assert torch.autograd.gradgradcheck(parts, (widths,))
    single = FILMS.transmission(widths.detach().float(), 533.0)
    assert float((single - FILMS.transmission(widths, 533.0)).abs().max()) < 1e-5


def test_held_out_nodes_are_an_upper_bound_of_the_error():
    by_width, by_wavelength = FILMS.held_out_errors()
    widths, waves = np.linspace(60, 230, 69), np.linspace(460, 640, 37)
    exact = np.array([[effective(w, nm) for w in widths] for nm in waves])
    worst = np.abs(interpolated(FILMS, widths, waves) - exact).max()
    assert worst < 0.2 * (by_width + by_wavelength)
    assert by_width + by_wavelength < 0.05


def test_a_table_of_one_wavelength_has_the_same_widths():
    row = [8]
    alone = CellTable(FILMS.widths, FILMS.wavelengths[row], FILMS.phase[row], FILMS.amplitude[row])
    widths = np.linspace(60, 230, 50)
    exact = effective(widths, FILMS.wavelengths[8])
    assert np.abs(interpolated(alone, widths, FILMS.wavelengths[row])[0] - exact).max() < 2e-3


def test_widths_are_those_whose_light_is_nearest_to_the_wanted_phase():
    phase = lens_phase(0.2, 532.0, 0.02)
    widths = cell_widths(FILMS, phase, 532.0, 0.00025)
    assert widths.shape == (160, 160)
    at = (np.arange(160) - 79.5) * 0.00025
    square = at[None] ** 2 + at[:, None] ** 2
    wanted = np.exp(-2j * np.pi / 532e-6 * (np.sqrt(square + 0.04) - 0.2))
    tried = effective(np.linspace(60, 230, 600), 532.0)
    best = np.abs(tried[:, None, None] - wanted[None, 60:80, 60:80]).min(0)
    found = np.abs(effective(widths.numpy(), 532.0) - wanted)
    assert np.abs(found[60:80, 60:80] - best).max() < 5e-3
    # Light of one phase of the whole turn alone is out of these cells' reach.
    assert abs((effective(widths.numpy(), 532.0) * wanted.conj()).mean()) > 0.95
    rings = cell_widths(FILMS, phase, 532.0, 0.00025, rings=True)
    assert rings.shape == (80,)
    assert float((rings[10] - widths[80, 90]).abs()) < 5.0
    with pytest.raises(InputError, match=r"wavelengths of 700 nm; .* holds 460 to 640 nm"):
        cell_widths(FILMS, phase, 700.0, 0.00025)
