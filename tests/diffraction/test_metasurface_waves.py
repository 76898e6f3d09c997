"""Waves behind the cells of a metasurface: films, gratings, a metalens, lost light."""

import math

import numpy as np
import pytest
import torch

from dolens.analysis.conditions import conditions
from dolens.diffraction.element_orders import element_flux
from dolens.diffraction.element_waves import element_light
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.pixel_psf import PixelWindow, wave_kernels
from dolens.diffraction.point_spread import point_spread
from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError
from dolens.optics.diffractive import lens_phase, order_efficiencies
from dolens.optics.metasurface import CellTable
from dolens.optimize import DesignVariables
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.cells import cell_rows, cell_widths
from tests.optics.nanopillars import FILMS, effective

ON_AXIS = ObjectPoints.at_infinity([[0.0, 0.0]])
CELLS = "surfaces.2.diffractive.widths"


def plate(widths, pitch, semi_diameter, distance, table=FILMS, phase=None, **data):
    """A plate of silica with cells behind, at a distance (mm) from the sensor."""
    plane = {"type": "plane", "semi_diameter": semi_diameter}
    cells = {"cells": cell_rows(table), "pitch": pitch, "widths": np.asarray(widths).tolist()}
    back = {**plane, "material": "air", "diffractive": cells, **({"phase": phase} if phase else {})}
    front = {**plane, "semi_diameter": 1.0, "thickness": 0.2, "material": "1.46"}
    sensor = {"distance": distance, "diameter": 0.1}
    given = {"stop": 2, "wavelengths": [532], "surfaces": {"1": front, "2": back}, "sensor": sensor}
    return lens_from_prescription(given | data)


def field(lens, points, u, wavelength, centre=((0.0, 0.0),), **settings):
    """The field (U, U) about a centre; its square is flux per mm², of an axial point's light."""
    light = element_light(
        lens.system(), points, wavelength, centre, DiffractionSettings(**settings)
    )
    return light.field(0, light.plan(0, float(u.abs().max())), u, u, torch.float64).detach()


def steps(count, width):
    return (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * (width / (count - 1))


@pytest.mark.parametrize("shape", [(64, 64), (32,)])
def test_equal_cells_are_a_uniform_film(shape):
    u = steps(15, 0.02)
    lens = plate(np.full(shape, 147.3), 0.0005, 0.015, 0.3)
    bare = plate(np.full(shape, 60.0), 0.0005, 0.015, 0.3)
    found = field(lens, ON_AXIS, u, 537.0, method="spectrum")
    # Cells of the first node of the table stand for light that meets none.
    reference = field(bare, ON_AXIS, u, 537.0, method="spectrum") / effective(60.0, 537.0)
    ratio = (found / reference)[reference.abs() > 0.1 * reference.abs().max()]
    assert float((ratio - effective(147.3, 537.0)).abs().max()) < 2e-3


def test_a_blazed_grating_of_cells_has_the_orders_of_its_fourier_sum():
    # Eight cells of 0.5 µm are a period; light of 560 nm on cells whose phases rise at 532 nm.
    tried = np.linspace(60, 230, 2000)
    wanted = np.exp(2j * np.pi * np.arange(8) / 8)
    period = tried[np.abs(effective(tried, 532.0)[:, None] - wanted).argmin(0)]
    lens = plate(np.tile(period, (256, 32)), 0.0005, 0.05, 2.0)
    equal = plate(np.full((256, 256), 150.0), 0.0005, 0.05, 2.0)
    u = steps(121, 0.24)
    given = {"method": "spectrum"}
    whole = field(equal, ON_AXIS, u, 560.0, **given).abs().square().sum()
    whole = float(whole) / abs(effective(150.0, 560.0)) ** 2
    for order in (-1, 0, 1, 2):
        sine = order * 560e-6 / 0.004
        centre = [[2.0 * sine / math.sqrt(1 - sine * sine), 0.0]]
        light = float(field(lens, ON_AXIS, u, 560.0, centre, **given).abs().square().sum())
        turns = np.exp(-2j * np.pi * order * np.arange(8) / 8)
        amplitude = (effective(period, 560.0) * turns).mean() * np.sinc(order / 8)
        assert light / whole == pytest.approx(abs(amplitude) ** 2, abs=0.01)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (6.0, -9.0)])
def test_a_metalens_focuses_as_the_integral_of_its_cells_does(angles):
    count, pitch, focal, radius = 96, 0.0004, 0.06, 0.019
    widths = cell_widths(FILMS, lens_phase(focal, 532.0, 0.0192), 532.0, pitch).numpy()
    assert widths.shape == (count, count)
    tangents = [math.tan(math.radians(angle)) for angle in angles]
    sines = [t / math.sqrt(1 + tangents[0] ** 2 + tangents[1] ** 2) for t in tangents]
    centre = [focal * s / math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2) for s in sines]
    u, points = steps(5, 0.003), ObjectPoints.at_infinity([list(angles)])
    lens = plate(widths, pitch, radius, focal)
    found = field(lens, points, u, 532.0, [centre], method="spectrum").abs().square().numpy()
    # Rayleigh and Sommerfeld's integral over parts of cells, in NumPy.
    parts, k = 6, 2 * np.pi / 532e-6
    x = (np.arange(count * parts) + 0.5 - 0.5 * count * parts) * (pitch / parts)
    lit = x[None] ** 2 + x[:, None] ** 2 < radius**2
    values = np.kron(effective(widths, 532.0), np.ones((parts, parts)))
    values = (values * np.exp(1j * k * (sines[0] * x[None] + sines[1] * x[:, None])))[lit]
    columns, rows = (grid[lit] for grid in np.meshgrid(x, x))
    exact = np.zeros((len(u), len(u)))
    for j, v in enumerate(u.numpy()):
        for i, w in enumerate(u.numpy()):
            r = np.sqrt((centre[0] + w - columns) ** 2 + (centre[1] + v - rows) ** 2 + focal**2)
            kernel = focal / r**2 * (1 / r - 1j * k) * np.exp(1j * k * r)
            exact[j, i] = abs((values * kernel).sum() * (pitch / parts) ** 2 / (2 * np.pi)) ** 2
    # Irradiance of one: the flux of an axial point; off the axis the fourth power of the cosine.
    exact *= (1 + tangents[0] ** 2 + tangents[1] ** 2) ** -2 / (math.pi * radius**2)
    assert np.abs(found - exact).max() < 0.005 * exact.max()


@pytest.mark.parametrize("shape", [(24, 24), (24,)])
def test_derivatives_by_widths_are_those_of_differences(shape):
    rng = np.random.default_rng(0)
    lens = plate(rng.uniform(80, 210, shape), 0.001, 0.011, 0.08)
    window = PixelWindow(0.001, 9)
    weights = torch.linspace(0.3, 1.0, 81, dtype=torch.float64).reshape(9, 9)

    def loss(widths):
        system = lens.with_values({CELLS: widths}).system()
        return (weights * wave_kernels(system, ON_AXIS, 545.0, None, window)).sum()

    (widths,) = lens.variables([CELLS]).values()
    (gradient,) = torch.autograd.grad(loss(widths), widths)
    way = torch.tensor(rng.normal(size=shape))
    with torch.no_grad():
        ends = [float(loss(widths + 1e-3 * sign * way)) for sign in (1, -1)]
    assert float((gradient * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-4)


def test_widths_are_learned_within_their_table():
    # A metalens that focuses at 0.2 mm is trained for 0.1 mm, with steps as long as the table.
    widths = cell_widths(FILMS, lens_phase(0.2, 532.0, 0.02), 532.0, 0.001)
    lens, window = plate(widths, 0.001, 0.02, 0.1), PixelWindow(0.001, 3)
    variables = DesignVariables(lens, {CELLS: {"scale": 50.0}})
    adam, bright = torch.optim.Adam(variables.parameters(), lr=0.3), []
    for _ in range(12):
        kernel = wave_kernels(lens.system(variables()), ON_AXIS, 532.0, None, window)
        bright.append(float(kernel.detach()[0, 1, 1]))
        adam.zero_grad()
        (-kernel[0, 1, 1]).backward()
        adam.step()
        variables.project()
    assert bright[-1] > 3.0 * bright[0]
    learned = variables()[CELLS].detach()
    assert (float(learned.min()), float(learned.max())) == pytest.approx((60.0, 230.0))


def test_the_share_that_leaves_cells_has_its_derivative():
    rng = np.random.default_rng(1)
    lens = plate(rng.uniform(80, 210, (24, 24)), 0.001, 0.011, 0.08)
    place = torch.tensor([545.0]), torch.zeros(1, 2)

    def share(widths):
        return element_flux(lens.with_values({CELLS: widths}).system(), ON_AXIS, *place)[1].sum()

    (widths,) = lens.variables([CELLS]).values()
    (gradient,) = torch.autograd.grad(share(widths), widths)
    way = torch.tensor(rng.normal(size=(24, 24)))
    with torch.no_grad():
        ends = [float(share(widths + 1e-3 * sign * way)) for sign in (1, -1)]
    assert float((gradient * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-4)
    x = (np.arange(24) - 11.5) * 0.001
    lit = x[None] ** 2 + x[:, None] ** 2 < 0.011**2
    passed = np.abs(effective(widths.detach().numpy(), 545.0)) ** 2
    assert float(share(widths.detach())) == pytest.approx(passed[lit].mean(), rel=5e-3)


def absorbing(share):
    """A table of the same phases, of which every cell passes a share of the power."""
    amplitude = np.full_like(FILMS.phase, math.sqrt(share))
    return CellTable(FILMS.widths, FILMS.wavelengths, FILMS.phase, amplitude)


def test_light_that_cells_keep_is_lost_and_is_no_haze():
    widths = cell_widths(FILMS, lens_phase(0.1, 532.0, 0.0192), 532.0, 0.0004)
    clear, dim = (plate(widths, 0.0004, 0.019, 0.1, absorbing(share)) for share in (1.0, 0.36))
    window = PixelWindow(0.001, 33)
    kernels = [wave_kernels(lens.system(), ON_AXIS, 532.0, None, window) for lens in (clear, dim)]
    assert float(kernels[1].sum() / kernels[0].sum()) == pytest.approx(0.36, rel=1e-6)
    where = conditions(clear, [[0.0, 0.0]], [532.0])
    spreads = [point_spread(lens, where, half_width_um=20.0) for lens in (clear, dim)]
    for part in ("irradiance", "held", "strehl_ratio"):
        bright, dark = (getattr(spread, part) for spread in spreads)
        assert torch.allclose(bright, dark, rtol=1e-5)
    curves = [diffraction_modulation(lens, where, [100.0, 300.0]) for lens in (clear, dim)]
    assert torch.allclose(curves[0].tangential, curves[1].tangential, rtol=1e-5)


def test_light_beside_the_cells_does_not_pass():
    small, window = plate(np.full((16, 16), 150.0), 0.0005, 0.02, 0.1), PixelWindow(0.01, 15)
    passed = float(wave_kernels(small.system(), ON_AXIS, 532.0, None, window).sum())
    area = 0.008**2 / (math.pi * 0.02**2)
    assert passed == pytest.approx(area * abs(effective(150.0, 532.0)) ** 2, rel=0.03)


def test_rays_see_the_phase_of_a_metalens_and_nothing_of_its_cells():
    phase = lens_phase(0.1, 532.0, 0.0192)
    widths = cell_widths(FILMS, phase, 532.0, 0.0004)
    lens = plate(widths, 0.0004, 0.019, 0.1, phase=phase)
    assert float(lens.first_order(532.0).efl) == pytest.approx(0.1)
    alone = plate(widths, 0.0004, 0.019, 0.1)
    with pytest.raises(InputError, match="surface 2 is diffractive by its cells alone"):
        alone.strehl()
    # Of waves the phase changes nothing but where windows stand.
    u, points = steps(9, 0.004), ObjectPoints.at_infinity([[3.0, 5.0]])
    middle = [[0.1 * math.tan(math.radians(3)), 0.1 * math.tan(math.radians(5))]]
    both = [field(one, points, u, 540.0, middle, method="spectrum").abs() for one in (lens, alone)]
    assert float((both[0] - both[1]).abs().max()) < 0.01 * float(both[0].max())


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda lens: lens.psf(fields=[0], wavelengths=[700]),
         "surface 2: wavelengths of 700 nm; the table of cells holds 460 to 640 nm"),
        (lambda lens: lens.with_values({CELLS: torch.full((9, 9), 59.0)})
         .psf(fields=[0]), "surface 2: widths of 59 nm; the table of cells holds 60 to 230 nm"),
        (lambda lens: order_efficiencies(lens, [1]), "surface 2 has cells, which have no orders"),
        (lambda lens: lens.polarisation(), "surface 2 has cells, whose light goes as waves"),
    ],
)  # fmt: skip
def test_what_a_table_does_not_hold_is_refused_in_one_line(ask, said):
    lens = plate(np.full((9, 9), 99.0), 0.004, 0.018, 0.2, phase=lens_phase(0.2, 532.0, 0.018))
    with pytest.raises(InputError, match=said) as error:
        ask(lens)
    assert "\n" not in str(error.value)


def test_cells_between_lenses_have_no_orders():
    plane = {"type": "plane", "semi_diameter": 0.02, "thickness": 0.2, "material": "air"}
    cells = {"cells": cell_rows(FILMS), "pitch": 0.004, "widths": [[99.0] * 9] * 9}
    phase = lens_phase(0.2, 532.0, 0.02)
    rows = {"1": {**plane, "phase": phase, "diffractive": cells}}
    rows["2"] = {"type": "sphere", "radius": 1.0, "semi_diameter": 0.05, "material": "1.5"}
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 0.2}})
    with pytest.raises(InputError, match="orders are those of a 'phase' alone"):
        wave_kernels(lens.system(), ON_AXIS, 532.0, [[0.0, 0.0]], PixelWindow(0.01, 9))
