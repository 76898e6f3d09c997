"""Diffractive elements between lenses: all orders, each through the rest of the lens."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j0

from dolens import InputError
from dolens.analysis.conditions import conditions
from dolens.diffraction import element_orders, pixel_psf
from dolens.diffraction.element_orders import orders_of
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.pixel_psf import PixelWindow, wave_kernels
from dolens.diffraction.point_spread import point_spread
from dolens.optics.diffractive import lens_phase
from dolens.prescriptions.build import lens_from_prescription, prescription_of

GLASS = "1.5/60"
ON_AXIS = ObjectPoints.at_infinity([[0.0, 0.0]])
ELEMENT = {"design_wavelength": 550.0}


def hybrid(zones=20, wavelength=480.0, **element):
    """A kinoform of so many zones in contact with an ideal lens of 50 mm, in focus."""
    plane = {"type": "plane", "semi_diameter": 1.0, "thickness": 0.3, "material": GLASS}
    phase = {"type": "radial", "norm_radius": 1.0, "p2": -2 * math.pi * zones}
    power = 1 / 50 + 2 * zones * wavelength * 1e-6
    rows = {
        "1": plane,
        "2": {"type": "plane", "semi_diameter": 2.0, "thickness": 1e-3, "material": "air",
              "phase": phase, "diffractive": {**ELEMENT, **element}},
        "3": {"type": "paraxial_lens", "focal_length": 50.0, "semi_diameter": 2.0,
              "material": "air"},
    }  # fmt: skip
    sensor = {"distance": 1 / power, "diameter": 2.0}
    return lens_from_prescription(
        {"stop": 1, "wavelengths": [wavelength], "surfaces": rows, "sensor": sensor}
    )


@pytest.mark.parametrize(("zones", "bound"), [(20, 2e-3), (3, 3e-3), (1.5, 6e-3)])
def test_the_orders_add_up_to_the_integral_of_the_whole_relief(zones, bound):
    """Kirchhoff's integral of the relief and the lens's sphere, to the second order in r/f, for a
    wavelength that leaves 5 % to other orders.
    """
    lens = hybrid(zones)
    pitch, wavenumber = 0.002, 2 * math.pi / 480e-6
    found = wave_kernels(lens.system(), ON_AXIS, 480.0, None, PixelWindow(pitch, 41))[0]
    z = float(lens.sensor_distance.detach())
    index = [float(lens.materials[1].index(w)) - 1.0 for w in (480.0, 550.0)]
    detuning = index[0] / index[1] * 550.0 / 480.0
    r = (np.arange(200_000) + 0.5) / 200_000
    turns = -zones * r**2
    relief = np.exp(2j * math.pi * detuning * (turns - np.floor(turns)))
    pupil = relief * np.exp(0.5j * wavenumber * r**2 * (1 / z - 1 / 50)) * r / 200_000
    at = np.arange(50) * 0.0005
    field = np.array([(pupil * j0(wavenumber * r * x / z)).sum() for x in at]) * wavenumber / z
    irradiance = np.abs(field) ** 2 / math.pi
    fine = (np.arange(-60, 61) / 20) * pitch * 0.5
    spline = pixel_psf.quadratic_b_spline(torch.as_tensor(fine / pitch)).numpy()
    expected = []
    for pixel in range(10):
        distance = np.hypot(pixel * pitch + fine[:, None], fine)
        light = np.interp(distance, at, irradiance) * spline[:, None] * spline
        expected.append(light.sum() * (fine[1] - fine[0]) ** 2)
    error = np.abs(found[20, 20:30].detach().numpy() - expected).max() / max(expected)
    assert error < bound


@pytest.mark.parametrize("element", [{}, {"levels": 4, "etch_scale": 1.05}])
def test_they_are_the_waves_of_an_element_that_is_the_last(element, monkeypatch):
    """In focus at 4 degrees, at a wavelength that is not the design's; far out of focus, where all
    orders are equally spread, their interference shows: 10 % of the peak.
    """
    plane = {"type": "plane", "semi_diameter": 1.0, "thickness": 0.5, "material": "1.4585/67.8"}
    back = {**plane, "semi_diameter": 0.4, "material": "air", "phase": lens_phase(8.0, 550, 0.4)}
    del back["thickness"]
    lens = lens_from_prescription(
        {
            "stop": 2,
            "surfaces": {"1": plane, "2": {**back, "diffractive": {**ELEMENT, **element}}},
            "sensor": {"distance": 8.8, "diameter": 2.0},
        }
    )
    given = ObjectPoints.at_infinity([[0.0, 4.0]]), 500.0, None, PixelWindow(0.002, 31)
    waves = wave_kernels(lens.system(), *given).detach()
    monkeypatch.setattr(pixel_psf, "light_goes_by_orders", lambda system: True)
    orders = wave_kernels(lens.system(), *given).detach()
    assert (orders - waves).abs().max() < 0.02 * waves.max()


def test_shares_are_those_of_light_from_the_side():
    """A grating on a plate in air: its path is h·(√(n² - p²) - √(1 - p²)), p the sine of the field,
    and blazed for 550 nm at normal incidence.
    """
    phase = {"type": "grating", "grooves": 20, "order": 1}
    rows = {
        "1": {"type": "plane", "semi_diameter": 1.0, "thickness": 0.1, "material": "air",
              "phase": phase, "diffractive": {**ELEMENT, "material": "1.5"}},
        "2": {"type": "sphere", "radius": 20.0, "semi_diameter": 2.0, "thickness": 1.0,
              "material": "1.5"},
        "3": {"type": "plane", "semi_diameter": 2.0, "material": "air"},
    }  # fmt: skip
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 30.0}})
    points = ObjectPoints.at_infinity(torch.tensor([[0.0, 0.0], [0.0, 35.0]]).double())
    waves = torch.tensor([550.0, 550.0], dtype=torch.float64)
    found = {o.numbers: o.share for o in orders_of(lens.system(), points, waves)}
    p = math.sin(math.radians(35.0))
    detuning = (math.sqrt(1.5**2 - p**2) - math.sqrt(1 - p**2)) / 0.5
    for order in (1, 2):
        known = [np.sinc(a - order) ** 2 for a in (1.0, detuning)]
        np.testing.assert_allclose(found[(order,)].numpy(), known, atol=1e-9)


def test_an_order_far_out_of_focus_is_even_light():
    """A disc of geometric radius R·|1 - z/f|, of the order's light."""
    lens = hybrid(60, 480.0)
    system = lens.system().double()
    waves = torch.tensor([480.0], dtype=torch.float64)
    orders = {o.numbers: o for o in orders_of(system, ON_AXIS, waves)}
    centre = torch.zeros(1, 2, dtype=torch.float64)
    z = float(lens.sensor_distance.detach())
    for order in (0, 2):
        power = 1 / 50 + 2 * 60 * order * 480e-6
        radius = abs(1 - z * power)
        light = ON_AXIS, waves, centre, 0.05
        found, even = element_orders.even_irradiance(orders[(order,)], *light)
        assert bool(even)
        share = float(orders[(order,)].share)
        assert float(found) == pytest.approx(share / (math.pi * radius**2), rel=0.05)
    _, even = element_orders.even_irradiance(orders[(1,)], ON_AXIS, waves, centre, 0.05)
    assert not bool(even)


def test_curved_surfaces_and_several_elements_have_orders_and_derivatives():
    """Differences of a pixel's light in both phases and a curvature; shares are products."""
    phase = {"type": "radial", "norm_radius": 1.0, "p2": -60.0}
    lens = hybrid(20, 530.0)
    given = prescription_of(lens)
    rows = given["surfaces"]
    rows["1"] = {"type": "sphere", "radius": 40.0, "semi_diameter": 1.0, "thickness": 0.3,
                 "material": GLASS, "phase": phase, "diffractive": ELEMENT}  # fmt: skip
    lens = lens_from_prescription(given)
    names = ("surfaces.1.phase.p2", "surfaces.2.phase.p2", "surfaces.1.curvature")
    window = PixelWindow(0.003, 9)

    def light(values):
        centre = torch.zeros(1, 2, dtype=torch.float64)
        return wave_kernels(lens.system(values), ON_AXIS, 530.0, centre, window)[0, 4, 5]

    stored = {name: lens.get_parameter(name).detach() for name in names}
    varied = {name: value.clone().requires_grad_() for name, value in stored.items()}
    slopes = torch.autograd.grad(light(varied), list(varied.values()))
    for (name, value), slope, step in zip(stored.items(), slopes, (0.01, 0.01, 1e-6), strict=True):
        with torch.no_grad():
            high, low = (light({**stored, name: value + s}) for s in (step, -step))
        assert float(slope) == pytest.approx(float(high - low) / (2 * step), rel=1e-3)
    waves = torch.tensor([530.0], dtype=torch.float64)
    orders = orders_of(lens.system(), ON_AXIS, waves)
    single = {o.numbers: float(o.share) for o in orders_of(hybrid(20).system(), ON_AXIS, waves)}
    assert float(orders[0].share) == pytest.approx(single[(1,)] ** 2)
    assert orders[0].numbers == (1, 1)


def test_views_add_the_orders():
    lens = hybrid(20)
    where = conditions(lens, [[0.0, 0.0]], [480.0])
    found = point_spread(lens, where)
    (share,) = (
        float(o.share)
        for o in orders_of(lens.system(), ON_AXIS, torch.tensor([480.0]).double())
        if o.numbers == (1,)
    )
    assert found.reasons[0].startswith("orders of a diffractive element, each by its pupil: 92.")
    # In focus the peak is that of the first order, and the others' light is far around.
    assert float(found.strehl_ratio) == pytest.approx(share, abs=0.01)
    assert share - 0.1 < float(found.held) < share + 0.01
    curves = diffraction_modulation(lens, where, [20.0, 60.0])
    s = np.array([20.0, 60.0]) * 480e-6 * float(lens.sensor_distance) / 2.0
    perfect = 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))
    np.testing.assert_allclose(curves.tangential[0].numpy(), share * perfect, atol=0.03)


def test_heights_alone_have_no_orders():
    rows = prescription_of(hybrid())["surfaces"]
    del rows["2"]["phase"]
    rows["2"]["diffractive"] = {"rings": [100.0], "pitch": 0.1}
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 20.0}})
    with pytest.raises(InputError, match=r"surface 3 behind .*; orders are those of a 'phase'"):
        wave_kernels(lens.system(), ON_AXIS, 550.0, [[0, 0]], PixelWindow(0.01, 9))
    rows["2"] |= {"type": "sphere", "radius": 30.0}
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 20.0}})
    with pytest.raises(InputError, match=r"surface 3 behind .*; orders are those of a 'phase'"):
        wave_kernels(lens.system(), ON_AXIS, 550.0, [[0, 0]], PixelWindow(0.01, 9))
