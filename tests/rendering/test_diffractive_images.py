"""Photographs through diffractive elements: all orders, where rays see the first."""

import math
from dataclasses import replace

import pytest
import torch

from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError
from dolens.experiments.camera.views.depths import DepthViews
from dolens.optics.diffractive import lens_phase, order_efficiencies
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.cells import cell_table, cell_widths
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_grid import (
    pinhole_places,
    place_functions,
    wave_point_spread_functions,
)
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

SENSOR = Sensor(64, 64, 0.004)
SCENE = PlanarScene(depths=(1000.0,), wavelengths=(550.0,))


def flat_lens(dtype=torch.float64, **diffractive):
    surfaces = {
        "1": {"type": "plane", "semi_diameter": 1.0, "thickness": 0.5, "material": "1.4585/67.8"},
        "2": {"type": "plane", "semi_diameter": 0.5, "material": "air",
              "phase": lens_phase(8.0, 550.0, 0.5),
              "diffractive": {"design_wavelength": 550, **diffractive}},
    }  # fmt: skip
    given = {"stop": 2, "surfaces": surfaces, "sensor": {"distance": 8.06, "diameter": 0.4}}
    return lens_from_prescription(given, dtype)


def texture():
    rows, columns = torch.meshgrid(*2 * (torch.arange(96, dtype=torch.float64),), indexing="ij")
    bars = 0.5 + 0.5 * torch.sign(torch.sin(0.35 * columns) * torch.sin(0.2 * rows))
    return bars.expand(1, 1, 96, 96)


def test_at_the_design_wavelength_the_relief_is_the_phase_that_rays_follow():
    lens = flat_lens()
    renderer = PsfRenderer(SENSOR, (2, 2), size=33, diffraction="wave")
    found = renderer.render(lens, SCENE, texture(), 0)
    lens.surfaces["2"].diffractive = None
    # Without the relief the wavefront in the exit pupil makes the picture.
    wanted = renderer.render(lens, SCENE, texture(), 0)
    # Light beyond the window, some 1.6 %, is even here; the other way gives it back in proportion.
    assert float(found.mean()) == pytest.approx(float(wanted.mean()), rel=2e-3)
    contrast = (
        float(((found - found.mean()) * wanted).sum() / wanted.var(correction=0)) / wanted.numel()
    )
    assert 0.97 < contrast < 1.0
    level = found.mean() + contrast * (wanted - wanted.mean())
    assert float((found - level).square().mean().sqrt()) < 0.002
    rays = RayRenderer(SENSOR, 8).render(lens, SCENE, texture(), 0)
    assert float(found.mean()) == pytest.approx(float(rays.mean()), rel=0.05)


def test_light_of_other_orders_is_haze_and_levels_have_gradients():
    lens = flat_lens(torch.float32)
    coarse = flat_lens(torch.float32, levels=2)
    renderer = PsfRenderer(SENSOR, (1, 1), size=33, diffraction="wave")
    whole, binary = (renderer.render(one, SCENE, texture(), 0) for one in (lens, coarse))
    # Two levels send 4/π² = 40.5 % into the first order; others are spread over a wide disc.
    assert float(binary.mean()) == pytest.approx(float(whole.mean()), rel=0.01)
    inner = (slice(None),) * 3 + (slice(16, 48),) * 2
    fine, coarse_bars = (
        float((image - image.roll(9, -1))[inner].square().mean().sqrt())
        for image in (whole, binary)
    )
    assert 0.38 < coarse_bars / fine < 0.47
    (slope,) = torch.autograd.grad(binary.square().mean(), coarse.surfaces["2"].phase.p4)
    assert float(slope) != 0.0


def test_light_that_cells_of_a_metasurface_keep_makes_the_picture_darker():
    pitch, turns = 0.0025, torch.linspace(0.0, 1.0, 25)
    rows = [["width_nm", "wavelength_nm", "phase_cycles", "power"]]
    bright = [[100.0 + 100.0 * turn, 550.0, turn, 1.0] for turn in turns.tolist()]
    pictures = []
    renderer = PsfRenderer(SENSOR, (1, 1), size=33, diffraction="wave")
    for share in (1.0, 0.49):
        table = rows + [[*row[:3], share] for row in bright]
        widths = cell_widths(cell_table(table), lens_phase(8.0, 550.0, 0.5), 550.0, pitch)
        lens = flat_lens(torch.float32)
        element = {"cells": table, "pitch": pitch, "widths": widths.tolist()}
        data = prescription_of(lens)
        data["surfaces"]["2"]["diffractive"] = element
        lens = lens_from_prescription(data, torch.float32)
        pictures.append(renderer.render(lens, SCENE, texture(), 0))
    assert float(pictures[1].mean() / pictures[0].mean()) == pytest.approx(0.49, rel=1e-3)
    kinoform = renderer.render(flat_lens(torch.float32), SCENE, texture(), 0)
    # What three and a half cells to a zone send into other orders is haze.
    assert float(pictures[0].mean() / kinoform.mean()) == pytest.approx(1.0, abs=0.02)
    (slope,) = torch.autograd.grad(
        pictures[1].square().mean(), lens.surfaces["2"].diffractive.widths
    )
    assert float(slope.abs().max()) > 0.0


def test_a_colour_has_the_light_of_its_band():
    system = flat_lens().system()
    renderer = PsfRenderer(SENSOR, (1, 1), size=33, diffraction="wave", band=(-20.0, 10.0))
    apart = [
        replace(renderer, band=(0.0,)).point_spread_functions(
            ImagingSystem.of(system, replace(SCENE, wavelengths=(wavelength,)), SENSOR), 0
        )
        for wavelength in (SCENE.wavelengths[0] - 20.0, SCENE.wavelengths[0] + 10.0)
    ]
    found = renderer.point_spread_functions(ImagingSystem.of(system, SCENE, SENSOR), 0).functions
    mean = 0.5 * (apart[0].functions + apart[1].functions)
    assert torch.allclose(found, mean, atol=1e-3 * float(mean.detach().max()))
    with pytest.raises(InputError, match=r"band .*diffraction is not wave"):
        replace(renderer, diffraction="none")


def test_a_network_is_told_waves_where_asked():
    lens = flat_lens(torch.float32, levels=2)
    renderer = PsfRenderer(SENSOR, (1, 1), size=33, diffraction="wave", band=(-20.0, 10.0))
    scene = replace(SCENE, wavelengths=(600.0, 550.0, 500.0))
    given = scene, renderer, Readout.at_light(100.0, 8000.0, read_noise=0.0004)
    told, rays = (
        DepthViews(*given, psf_size=33, psf_diffraction=how).point_spread_functions(lens)
        for how in ("wave", "none")
    )
    shown = renderer.point_spread_functions(ImagingSystem.of(lens.system(), scene, SENSOR), 0)
    assert torch.allclose(told, shown.functions[0], atol=1e-3 * float(told.max()))
    # Rays know one order of an element of two levels, and all light in it.
    sharp = (slice(12, 21),) * 2
    assert float(told[0, 1][sharp].sum()) < 0.5 < 0.9 < float(rays[0, 1][sharp].sum())
    assert float(told[0, 1].sum()) == pytest.approx(float(rays[0, 1].sum()), rel=0.02)


@pytest.mark.parametrize(("levels", "wavelength"), [(2, 550.0), (4, 550.0), (None, 450.0)])
def test_rays_of_every_order_make_what_waves_make(levels, wavelength):
    """Pixels are as wide as the Airy disc: what is left is where the light of orders goes."""
    given = {} if levels is None else {"levels": levels}
    lens = flat_lens(**given)
    sensor = Sensor(33, 33, 0.02)
    scene = replace(SCENE, wavelengths=(wavelength,))
    imaging = ImagingSystem.of(lens.system(), scene, sensor)
    by_orders, by_one = (
        PsfRenderer(sensor, (1, 1), 64, 33, "centred", diffraction=how)
        .point_spread_functions(imaging, 0)
        .functions[0, 0, 0]
        for how in ("orders", "limit")
    )
    axis = (torch.zeros(1, dtype=torch.float64),) * 2
    fine = DiffractionSettings(samples=800)
    by_waves = wave_point_spread_functions(imaging, axis, 33, False, fine).functions[0, 0, 0]
    assert float(by_orders.sum()) == pytest.approx(1.0, abs=0.01)
    share = float(order_efficiencies(lens, [1], [wavelength])[0, 0])
    sharp = (slice(15, 18),) * 2
    assert float(by_orders[sharp].sum()) == pytest.approx(float(by_waves[sharp].sum()), abs=0.02)
    # Rays' order alone has all light in one place.
    apart, alone = (float((one - by_waves).abs().sum()) for one in (by_orders, by_one))
    assert apart < 0.1 and alone > 1.5 * (1.0 - share)


def test_restorers_of_a_field_are_told_all_orders():
    """Two levels send 4/π² = 40.5 % into rays' order, on the axis and beside it."""
    sensor = Sensor(33, 33, 0.02)
    imaging = ImagingSystem.of(flat_lens(levels=2).system(), SCENE, sensor)
    points = torch.tensor([0.0, 0.1]).double(), torch.zeros(2).double()
    ideal = pinhole_places(imaging, points)
    sharp = (..., slice(14, 19), slice(14, 19))
    held = {
        how: place_functions(imaging, points, ideal, 33, how).functions[sharp].sum((-2, -1))
        for how in ("limit", "orders")
    }
    assert torch.allclose(held["orders"], 4.0 / math.pi**2 * held["limit"], rtol=0.06)
    assert float(held["limit"].min()) > 0.95


def test_rays_do_not_show_heights_alone():
    lens = flat_lens()
    surface = lens.surfaces["2"]
    surface.phase = None
    with pytest.raises(InputError, match="heights alone, which rays do not see"):
        RayRenderer(SENSOR, 4).render(lens, SCENE, texture(), 0)
    rings = flat_lens(rings=[0.0, 100.0], pitch=0.1)
    orders = PsfRenderer(SENSOR, (1, 1), 4, 33, diffraction="orders")
    with pytest.raises(InputError, match="surface 2 has heights or cells, which have no orders"):
        orders.render(rings, SCENE, texture(), 0)


def test_auto_asks_waves_whether_the_order_of_rays_is_enough():
    plans = {}
    for levels, sensor in ((2, SENSOR), (None, Sensor(64, 64, 0.03))):
        element = {} if levels is None else {"levels": levels}
        renderer = AutoRenderer(sensor, tolerance=4.0)
        renderer.prepare(flat_lens(torch.float32, **element), SCENE)
        plans[levels] = renderer.choice
    # Rays of all orders are enough, with a window for what is haze.
    assert plans[2].renderer.diffraction == "orders" and plans[2].renderer.size > 100
    assert any("other orders than rays'" in line for line in plans[2].lines())
    # A blazed relief at its wavelength, and pixels far larger than the Airy disc.
    assert plans[None].renderer.settings().get("diffraction", "none") == "none"
