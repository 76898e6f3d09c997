"""Cells that pass light along their x and y apart, turned, between polarisers and retarders."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dolens.diffraction.element_waves import element_light
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pixel_psf import PixelWindow, wave_kernels
from dolens.errors import InputError
from dolens.optics.diffractive import lens_phase
from dolens.optics.metasurface import CellTable
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.cells import cell_rows, cell_table, cell_widths
from tests.optics.nanopillars import FILMS, RIDGE, film

ON_AXIS, WINDOW = ObjectPoints.at_infinity([[0.0, 0.0]]), PixelWindow(0.001, 17)
FOCAL, RADIUS, PITCH = 0.1, 0.019, 0.0004
NODES = np.linspace(60.0, 230.0, 35)


def table(x, y=None):
    """A table at 532 nm of complex amplitudes of widths, of light along x and y."""
    both = [CellTable(NODES, [532.0], [np.angle(t)], [np.abs(t)]) for t in (x, y) if t is not None]
    return replace(both[0], along_y=both[1]) if len(both) > 1 else both[0]


def across(widths):
    """Films of ridges far finer than the wavelength, light polarised across them (Rytov)."""
    return film((1 + widths / 250.0 * (RIDGE**-2 - 1)) ** -0.5, 532.0)


RIDGES = table(film(np.sqrt(1 + NODES / 250.0 * (RIDGE**2 - 1)), 532.0), across(NODES))
ONES = np.ones_like(NODES)


def lens(of, widths, angles=None, **beside):
    cells = {"cells": cell_rows(of), "pitch": PITCH, "widths": np.asarray(widths).tolist()}
    cells |= {} if angles is None else {"angles": np.asarray(angles).tolist()}
    plane = {"type": "plane", "semi_diameter": RADIUS, "material": "air"}
    return lens_from_prescription(
        {
            "wavelengths": [532],
            "surfaces": {"1": {**plane, "diffractive": cells | beside}},
            "sensor": {"distance": FOCAL, "diameter": 0.02},
        }
    )


def kernel(of):
    return wave_kernels(of.system(), ON_AXIS, 532.0, [[0.0, 0.0]], WINDOW)[0].detach()


def circular(sense):
    """A polariser and a quarter-wave plate in front, and an analyser of the other sense."""
    front = [{"polariser": 45.0 * sense}, {"retarder": 0.0, "retardance": 90.0}]
    behind = [{"retarder": 0.0, "retardance": 90.0}, {"polariser": 45.0 * sense}]
    return {"front": front, "behind": behind}


def wanted_phase():
    at = (np.arange(96) - 47.5) * PITCH
    r2 = at**2 + at[:, None] ** 2
    return -2.0 * np.pi / 532e-6 * (np.sqrt(r2 + FOCAL**2) - FOCAL)


def test_turned_half_wave_cells_focus_one_circular_light_and_spread_the_other():
    """Their phase is twice the angle, of either sign (Pancharatnam and Berry)."""
    angles, widths = np.degrees(wanted_phase()) / 2.0, np.full((96, 96), 100.0)
    half_wave = table(ONES, -ONES)
    by_phase = table(np.exp(2j * np.pi * (NODES - 60.0) / 170.0))
    turns = np.mod(wanted_phase() / (2.0 * np.pi), 1.0)
    ideal = kernel(lens(by_phase, 60.0 + 170.0 * turns))
    focused, spread = (kernel(lens(half_wave, widths, angles, **circular(s))) for s in (1, -1))
    if focused.max() < spread.max():
        focused, spread = spread, focused
    # A polariser passes half of unpolarised light.
    assert torch.allclose(focused, 0.5 * ideal, atol=2e-4 * float(ideal.max()))
    assert float(spread.max()) < 0.01 * float(focused.max())
    # Unpolarised light is one half of each.
    both = kernel(lens(half_wave, widths, angles))
    assert torch.allclose(both, focused + spread, atol=1e-6 * float(both.max()))


def test_one_of_two_circular_lights_is_named_right():
    """A phase that falls outwards focuses; the field (1, -i) gets the phase +2θ."""
    angles, half_wave = np.degrees(wanted_phase()) / 2.0, table(ONES, -ONES)
    turn = np.array([[1, 0], [0, 1j]])  # a quarter-wave plate along x, but for a common phase
    focus = []
    for sense in (1, -1):
        field = turn @ np.array([1.0, sense]) / math.sqrt(2)
        theta = 0.3
        c, s = math.cos(theta), math.sin(theta)
        rotation = np.array([[c, -s], [s, c]])
        out = rotation @ np.diag([1, -1]) @ rotation.T @ field
        focus.append(np.vdot(field.conj(), out))  # the other sense's amplitude
    assert np.angle(focus) == pytest.approx([-0.6, 0.6]) or np.angle(focus) == pytest.approx(
        [0.6, -0.6]
    )
    plus = int(np.argmax(np.angle(focus)))
    peaks = [
        float(kernel(lens(half_wave, np.full((96, 96), 100.0), angles, **circular(s))).max())
        for s in (1, -1)
    ]
    assert int(np.argmax(peaks)) == plus


@pytest.mark.parametrize("shape", [(96, 96), (50,)])
def test_equal_cells_pass_what_jones_matrices_say(shape):
    """Ridges at 34°, behind a polariser at 20° and before one at -70° behind a retarder."""
    front = [{"polariser": 20.0, "extinction": 0.1}]
    behind = [{"retarder": 10.0, "retardance": 70.0}, {"polariser": -70.0}]
    width, turned = 151.0, np.full(shape, 34.0)

    def rotated(degrees, x, y):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        turn = np.array([[c, -s], [s, c]])
        return turn @ np.diag([x, y]) @ turn.T

    x, y = film(math.sqrt(1 + width / 250.0 * (RIDGE**2 - 1)), 532.0), across(width)
    half = math.radians(35.0)
    matrices = [
        rotated(-70, 1, 0),
        rotated(10, np.exp(-1j * half), np.exp(1j * half)),
        rotated(34, x, y),
        rotated(20, 1, math.sqrt(0.1)),
    ]
    for which, given in (
        (matrices, {"front": front, "behind": behind}),
        (matrices[2:], {"front": front}),
        (matrices[2:3], {}),
    ):
        jones = which[0] if len(which) == 1 else np.linalg.multi_dot(which)
        of = lens(RIDGES, np.full(shape, width), turned, **given)
        light = element_light(of.system(), ON_AXIS, 532.0, [[0.0, 0.0]])
        share = float(light.passed_share(0, light.plan(0, 0.01)).detach())
        assert share == pytest.approx(0.5 * np.sum(np.abs(jones) ** 2), rel=2e-4)


def test_cells_that_pass_both_polarisations_alike_do_not_see_how_they_are_turned():
    rng = np.random.default_rng(0)
    widths, angles = rng.uniform(80, 210, (96, 96)), rng.uniform(-90, 90, (96, 96))
    alike = replace(FILMS, along_y=FILMS)
    plain, turned = kernel(lens(FILMS, widths)), kernel(lens(alike, widths, angles))
    assert torch.allclose(turned, plain, rtol=1e-9, atol=1e-9 * float(plain.max()))


@pytest.mark.parametrize("shape", [(24, 24), (24,)])
@pytest.mark.parametrize("beside", [{}, circular(1)])
def test_derivatives_by_widths_and_angles_are_those_of_differences(shape, beside):
    rng = np.random.default_rng(0)
    made = rng.uniform(80, 210, shape), rng.uniform(-90, 90, shape)
    of = lens(RIDGES, *made, **beside)
    names = [f"surfaces.1.diffractive.{name}" for name in ("widths", "angles")]
    weights = torch.linspace(0.3, 1.0, 17 * 17, dtype=torch.float64).reshape(17, 17)

    def loss(values):
        system = of.with_values(dict(zip(names, values, strict=True))).system()
        return (weights * wave_kernels(system, ON_AXIS, 532.0, [[0.0, 0.0]], WINDOW)[0]).sum()

    values = [*of.variables(names).values()]
    for k, gradient in enumerate(torch.autograd.grad(loss(values), values)):
        way, ends = torch.tensor(rng.normal(size=shape)), []
        for sign in (1e-3, -1e-3):
            moved = [v.detach() + sign * way if i == k else v for i, v in enumerate(values)]
            ends.append(float(loss(moved).detach()))
        assert float((gradient * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-4)


def test_widths_for_a_phase_serve_both_polarisations():
    """Of two tables, one of which is of the other phase at each width, no width serves both."""
    phase = lens_phase(FOCAL, 532.0, RADIUS)
    turned = np.exp(2j * np.pi * (NODES - 60.0) / 170.0)
    alone, alike = table(turned), table(turned, turned)
    given = phase, 532.0, 0.002, RADIUS
    assert torch.equal(cell_widths(alone, *given), cell_widths(alike, *given))
    bent = table(turned, turned * np.exp(0.4j))
    moved = (cell_widths(alone, *given) - cell_widths(bent, *given)) % 170.0
    # The mean is 0.2 radians ahead.
    assert float(moved.median()) == pytest.approx(170.0 * 0.2 / (2 * math.pi), abs=0.3)


def test_polarised_cells_are_written_and_read_to_the_last_bit():
    rng = np.random.default_rng(2)
    of = lens(RIDGES, rng.uniform(80, 210, (5, 7)), rng.uniform(-90, 90, (5, 7)), **circular(1))
    again = lens_from_prescription(prescription_of(of))
    first, second = (one.surfaces["1"].diffractive for one in (of, again))
    assert torch.equal(first.widths, second.widths) and torch.equal(first.angles, second.angles)
    assert first.cells.front == second.cells.front and first.cells.behind == second.cells.behind
    for along in (lambda t: t, lambda t: t.along_y):
        one, two = along(first.table), along(second.table)
        assert np.array_equal(one.phase, two.phase) and np.array_equal(one.amplitude, two.amplitude)
    columns = ["power_y", "phase_cycles", "width_nm", "phase_y_cycles", "wavelength_nm", "power"]
    read = cell_table([columns, *([0.25, 0.5, w, 0.125, 500, 0.81] for w in (90, 100))])
    assert read.along_y is not None
    assert [float(t[0, 0]) for t in (read.phase, read.amplitude)] == pytest.approx([math.pi, 0.9])
    other = read.along_y.phase, read.along_y.amplitude
    assert [float(t[0, 1]) for t in other] == pytest.approx([math.pi / 4, 0.5])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"of": FILMS, "angles": [[1.0]]},
         "'angles', 'front' and 'behind' need a table with the phase and power of light along each "
         "cell's own y"),
        ({"of": FILMS, "front": [{"polariser": 0}]}, "need a table"),
        ({"angles": [1.0]}, "'angles' must be as many as 'widths', degrees"),
        ({"front": [{"polariser": 0}], "behind": [{"polariser": 90}]},
         "'front', cells and 'behind' together pass no light"),
        ({"front": {"polariser": 0}}, "'front': must be a list of elements, not one"),
        ({"front": 45}, "'front': must be a list of elements, not one"),
        ({"behind": [{"mirror": 0}]}, "'behind': element 1"),
    ],
)  # fmt: skip
def test_what_makes_no_polarised_cells_is_refused_in_one_line(given, said):
    with pytest.raises(InputError, match=said) as error:
        lens(**({"of": RIDGES, "widths": [[100.0]]} | given))
    assert str(error.value).startswith("lens: surface 1: diffractive: ") and "\n" not in str(
        error.value
    )
