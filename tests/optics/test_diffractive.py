"""Diffractive elements as data: reliefs, what they do to light, and the share of every order."""

import math

import numpy as np
import pytest
import torch

from dolens.errors import InputError
from dolens.optics.diffractive import (
    PhaseOnGrid,
    Relief,
    lens_phase,
    relief_efficiencies,
    transmission,
)
from dolens.optics.materials import index_model, parse_material
from dolens.prescriptions.build import lens_from_prescription, prescription_of

MODEL = index_model("dfc")
AIR, SILICA = parse_material("air", MODEL), parse_material("1.4585/67.8", MODEL)
MEDIA = (SILICA, AIR)


def ratio(wavelength, design=550.0):
    """α of the module."""
    step = [float(SILICA.index(w)) - 1.0 for w in (wavelength, design)]
    return design / wavelength * step[0] / step[1]


def grid(count, pitch):
    return (torch.arange(count, dtype=torch.float64) + 0.5 - 0.5 * count) * pitch


def prescription(diffractive, **row):
    surface = {"type": "plane", "semi_diameter": 1, "material": "air", "diffractive": diffractive}
    front = {"type": "plane", "semi_diameter": 1, "thickness": 1, "material": "1.4585/67.8"}
    return {"surfaces": {"1": front, "2": {**surface, **row}}, "sensor": {"distance": 8}}


@pytest.mark.parametrize("blaze", [1, 3, -1])
def test_blazed_reliefs_share_light_by_sinc_squared(blaze):
    orders = [-2, -1, 0, 1, 2, 3, 4]
    found = relief_efficiencies(Relief(design_wavelength=550.0), orders, [450, 550], MEDIA, blaze)
    exact = [[np.sinc(blaze * ratio(w) - m) ** 2 for m in orders] for w in (450, 550)]
    np.testing.assert_allclose(found.numpy(), exact, atol=1e-12)
    assert float(found[1, orders.index(blaze)]) == 1.0


@pytest.mark.parametrize("levels", [2, 4, 8, 16])
def test_levels_pass_sinc_squared_of_one_over_their_number_into_the_first_order(levels):
    relief = Relief(design_wavelength=550.0, levels=levels)
    found = relief_efficiencies(relief, range(-40, 41), [550.0], MEDIA)[0]
    assert float(found[41]) == pytest.approx(np.sinc(1 / levels) ** 2, abs=1e-12)
    # The others are of order 1 plus multiples of the levels.
    others = {m for m in range(-40, 41) if float(found[m + 40]) > 1e-12}
    assert others == {m for m in range(-40, 41) if (m - 1) % levels == 0}
    assert float(found.sum()) == pytest.approx(1.0, abs=0.02)


def test_a_multi_order_lens_is_blazed_at_its_harmonics():
    relief = Relief(design_wavelength=550.0)
    # Where M·α is a whole number all light goes into that order.
    for order in (9, 10, 11):
        from_dispersion = min(
            np.linspace(450, 700, 100001), key=lambda w: abs(10 * ratio(w) - order)
        )
        found = relief_efficiencies(relief, [order], [from_dispersion], MEDIA, 10)
        assert float(found[0, 0]) == pytest.approx(1.0, abs=1e-6)


def test_the_transmission_of_a_period_has_its_orders_as_fourier_coefficients():
    # 64 cells a period of 64 µm, 450 nm on a relief for 550 nm; orders by a sum over the period.
    x, y = grid(64, 1e-3), grid(2, 1e-3)
    phase = 2 * math.pi / 0.064 * (x - x[0] + 0.5e-3).expand(2, -1)
    slope = torch.full_like(phase, 2 * math.pi / 0.064)
    on_grid = PhaseOnGrid(phase, slope, torch.zeros_like(slope), 1)
    for levels in (None, 4):
        relief = Relief(design_wavelength=550.0, levels=levels, etch_scale=1.02)
        path = relief.step(*MEDIA, 450.0) / 450.0
        passed = transmission(relief, x, y, path, MEDIA, on_grid)[0]
        found = [
            float((passed * torch.exp(-1j * m * phase[0])).mean().abs() ** 2) for m in (0, 1, 2)
        ]
        exact = relief_efficiencies(relief, [0, 1, 2], [450.0], MEDIA)[0]
        np.testing.assert_allclose(found, exact.numpy(), atol=2e-3)


def test_etched_masks_add_their_errors_where_they_etch():
    relief = Relief(design_wavelength=550.0, levels=4, etch_errors=(10.0, -20.0))
    period = relief.period(1, *MEDIA)
    heights = torch.arange(4, dtype=torch.float64) * period / 4
    made = relief.made(heights, period)
    np.testing.assert_allclose((made - heights).numpy(), [0.0, 10.0, -20.0, -10.0], atol=1e-9)
    # Light that all masks etch wrongly is lost from the first order.
    perfect = relief_efficiencies(Relief(design_wavelength=550.0, levels=4), [1], [550.0], MEDIA)
    assert float(relief_efficiencies(relief, [1], [550.0], MEDIA)) < float(perfect)


def test_heights_delay_light_by_the_normal_wavevectors_and_gradients_pass_levels():
    heights = torch.tensor([[0.0, 300.0], [600.0, 900.0]], dtype=torch.float64, requires_grad=True)
    relief = Relief(heights=heights, pitch=0.01, depth=1200.0)
    x = grid(4, 0.005)
    sine = 0.3
    path = (math.sqrt(float(SILICA.index(550.0)) ** 2 - sine**2) - math.sqrt(1 - sine**2)) / 550
    passed = transmission(relief, x, x, path, MEDIA)
    assert float(passed[0, 3].angle().detach()) == pytest.approx(2 * math.pi * 300 * path)
    exact = torch.exp(2j * math.pi * heights[1, 0] * path)
    assert float((passed[2, 1] / exact).real.detach()) == pytest.approx(1)
    rough = Relief(heights=heights, pitch=0.01, depth=1200.0, levels=2)
    made = transmission(rough, x, x, path, MEDIA)
    assert float(made[0, 3].abs().detach()) == pytest.approx(1.0)
    (slope,) = torch.autograd.grad(made[0, 3].imag, heights)
    # Height 300 is made as 600 or 0; the derivative is that of the height itself.
    step = 2 * math.pi * path
    made_height = float(rough.made(heights, 1200.0)[0, 1].detach())
    assert float(slope[0, 1]) == pytest.approx(step * math.cos(step * made_height))


def test_pixels_fill_their_share_and_rings_their_radii():
    pixels = Relief(heights=torch.full((2, 2), 600.0).double(), pitch=0.01, fill=0.5)
    x = grid(8, 0.0025)
    path = 1.0 / 1200.0  # half a turn: +1 where there is no relief, -1 where there is
    passed = transmission(pixels, x, x, path, MEDIA).real
    assert float(passed.mean()) == pytest.approx(1.0 - 2.0 * 0.25)
    rings = Relief(heights=torch.tensor([600.0, 0.0, 600.0]).double(), pitch=0.1)
    x = grid(600, 0.001)
    lit = (1.0 - transmission(rings, x, x, path, MEDIA).real.mean()) / 2.0 * 0.36
    assert float(lit) == pytest.approx(math.pi * (0.1**2 + 0.3**2 - 0.2**2), rel=1e-3)


def test_edges_of_zones_move_with_their_phase_in_value_and_derivative():
    # The mean of a binary-looking relief off its wavelength: zones' edges count.
    x, y = grid(200, 1e-3), grid(2, 1e-3)
    relief = Relief(design_wavelength=550.0)
    path = relief.step(*MEDIA, 400.0) / 400.0

    def mean(scale):
        phase = scale * x.square().expand(2, -1)
        slope = 2.0 * scale * x.expand(2, -1)
        on_grid = PhaseOnGrid(phase, slope, torch.zeros_like(slope), 1)
        return transmission(relief, x, y, path, MEDIA, on_grid).real.mean()

    scale = torch.tensor(3000.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(mean(scale), scale)
    with torch.no_grad():
        difference = (mean(scale + 5.0) - mean(scale - 5.0)) / 10.0
    assert float(slope) == pytest.approx(float(difference), rel=0.05)


def test_a_lens_by_formula_sends_all_its_light_to_the_focus():
    found = lens_phase(8.0, 550.0, 2.0)
    r = np.linspace(0, 2, 11)
    series = sum(found[f"p{2 * k}"] * (r / 2.0) ** (2 * k) for k in range(1, 11))
    exact = -2 * np.pi / 550e-6 * (np.sqrt(r**2 + 64) - 8)
    np.testing.assert_allclose(series, exact, atol=1e-4)
    lens = lens_from_prescription(prescription({"design_wavelength": 550}, phase=found))
    assert float(lens.first_order(550.0).efl) == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("element", "row"),
    [
        ({"design_wavelength": 550, "levels": 9, "etch_scale": 2}, {"phase": lens_phase(8, 5, 1)}),
        ({"pixels": [[0, 100.5], [7, 1]], "pitch": 0.002, "depth": 1000, "fill": 0.9}, {}),
        ({"rings": [1, 2, 3], "pitch": 0.01, "material": "1.6/30", "depth": 900, "levels": 4,
          "etch_errors": [1, 2]}, {}),
    ],
)  # fmt: skip
def test_elements_are_written_as_they_are_read(element, row):
    lens = lens_from_prescription(prescription(element, **row))
    written = prescription_of(lens)
    again = prescription_of(lens_from_prescription(written))
    assert written == again
    found = written["surfaces"]["2"]["diffractive"]
    assert {key: found[key] for key in element} == element


@pytest.mark.parametrize(
    ("element", "said"),
    [
        ({"design_wavelength": 550}, "needs 'pixels' or 'rings', or a 'phase'"),
        ({"rings": [1]}, "'pitch' must be given"),
        ({"rings": [1], "pitch": 0.1, "levels": 4}, "'levels' need a 'depth'"),
        ({"rings": [1], "pitch": 0.1, "depth": -4}, "'depth' must be positive"),
        ({"rings": [1], "pitch": 0.1, "fill": 0.5}, "'fill' is a share of pixels"),
        ({"rings": [1], "pitch": 0.1, "material": "1.4585/67.8", "dept": 3}, "unknown key 'dept'"),
        ({"pixels": [1, 2], "pitch": 0.1}, "'pixels' must be rows"),
        ({"pixels": [[1, 2]], "rings": [1], "pitch": 0.1}, "not both"),
        ({"rings": [1], "pitch": 0.1, "material": "air"}, "does nothing"),
        (
            {"rings": [1], "pitch": 0.1, "depth": 9, "levels": 4, "etch_errors": [1]},
            "make 2 levels",
        ),
    ],
)
def test_what_makes_no_element_is_refused_in_one_line(element, said):
    with pytest.raises(InputError) as error:
        lens_from_prescription(prescription(element))
    assert said in str(error.value)
    assert str(error.value).startswith("lens: surface 2: diffractive: ")
    assert "\n" not in str(error.value)


def test_a_curved_surface_has_heights_or_the_relief_of_a_phase():
    curved = {"type": "sphere", "radius": 9.0}
    heights, phase = {"rings": [1], "pitch": 1}, {"design_wavelength": 550}
    lens_from_prescription(prescription(heights, **curved))
    lens_from_prescription(prescription(phase, phase=lens_phase(8, 550, 1), **curved))
    with pytest.raises(InputError, match="type 'sphere' has 'rings' or a 'phase', not both"):
        lens_from_prescription(prescription(heights | phase, phase=lens_phase(8, 550, 1), **curved))


def test_heights_are_parameters_of_the_lens():
    lens = lens_from_prescription(prescription({"rings": [1, 2], "pitch": 0.1}))
    assert list(lens.variables(["surfaces.2.diffractive.*"])) == ["surfaces.2.diffractive.heights"]
    other = lens.system({"surfaces.2.diffractive.heights": torch.tensor([5.0, 6.0])})
    assert other.surfaces[1].relief.heights.tolist() == [5.0, 6.0]
    lens.surfaces["2"].diffractive.heights = torch.nn.Parameter(torch.tensor([7.0, 8.0]).double())
    assert lens.system().surfaces[1].relief.heights.tolist() == [7.0, 8.0]
    assert "diffractive element of surface 2: 2 rings of 0.1 mm" in str(lens)
