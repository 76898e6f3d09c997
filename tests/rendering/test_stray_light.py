"""Lights in pictures: their own light, their ghosts, and what is refused."""

import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.ghosts import ghosts
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.starburst import bands, starburst
from dolens.rendering.stray_light import Light, light_on_sensor, lights_of, veil
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from tests.diffraction.perfect_lenses import hyperbola

GREEN = 550.0
# 18 mm by 18 mm behind a triplet of f = 50 mm.
SENSOR = Sensor(61, 61, 0.3)
FAR = 1e6


@pytest.fixture(scope="module")
def bare():
    return load_lens("cooke_triplet").coated("none").requires_grad_(False)


@pytest.fixture(scope="module")
def imaging(bare):
    return ImagingSystem.of(bare.system(), PlanarScene((FAR,), (GREEN,)), SENSOR)


def light(row, column, power=100.0):
    return Light(row, column, (power, power, power))


def test_a_light_brings_as_much_light_as_so_many_white_pixels(bare, imaging):
    """The white of an axial pixel is 1 behind an ideal lens: behind this one what passes."""
    passed = float(bare.transmission(0.0, GREEN).share)
    image = light_on_sensor(bare, imaging, 0, [light(30, 30)], rays=800)[0]
    around = image[27:34, 27:34]
    assert float(around.sum()) == pytest.approx(100.0 * passed, rel=0.015)
    assert divmod(int(image.argmax()), 61) == (30, 30)


def test_it_is_imaged_upright(bare, imaging):
    image = light_on_sensor(bare, imaging, 0, [light(12, 45)], rays=200)[0]
    row, column = divmod(int(image.argmax()), 61)
    # The lens's own distortion draws it towards the axis by less than a pixel.
    assert abs(row - 12) <= 1 and abs(column - 45) <= 1


def test_ghosts_have_the_power_that_their_analysis_gives(bare, imaging):
    """Over the image's power, for a light on the axis; other rays, and a square for a circle."""
    found = light_on_sensor(bare, imaging, 0, [light(30, 30)], rays=800)[0]
    own = float(found[27:34, 27:34].sum())
    stray = float(found.sum()) - own
    known = ghosts(bare, conditions(bare, [0.0], [GREEN]), rays=800)
    inside = [r < 9.0 for r in known.measures.rms.nan_to_num(math.inf).tolist()]
    least = sum(p for p, small in zip(known.measures.power.tolist(), inside, strict=True) if small)
    assert 0.5 * least < stray / own < 1.1 * known.total


def test_four_reflections_are_added_to_two(bare):
    """What they add has the power of the paths of four, on a sensor that misses little of it."""
    wide = ImagingSystem.of(bare.system(), PlanarScene((FAR,), (GREEN,)), Sensor(61, 61, 0.6))
    two, four = (
        light_on_sensor(bare, wide, 0, [light(30, 30)], 400, diffraction=False, bounces=n).sum()
        for n in (2, 4)
    )
    known = ghosts(bare, conditions(bare, [0.0], [GREEN]), rays=400, bounces=4)
    landed = known.measures.rms.nan_to_num(0.0) < 9.0
    least = float(known.measures.power[landed].nansum())
    # The image has 2 to 3 % less light than all that there is with ghosts of two reflections.
    assert 0.95 * least < float((four - two) / two) < known.total
    with pytest.raises(InputError, match="bounces: 3; allowed: 2, 4, 6"):
        light_on_sensor(bare, wide, 0, [], bounces=3)


def test_coatings_quench_ghosts(bare, imaging):
    coated = bare.coated("quarter_wave").requires_grad_(False)
    both = [float(veil(lens, imaging, 0)) for lens in (bare, coated)]
    # Two reflections of some 1 % in the place of 5 %.
    assert both[0] > 0.005 and both[1] < 0.15 * both[0]


def test_the_derivative_of_stray_light_is_that_of_its_number(imaging):
    lens = load_lens("cooke_triplet").coated("quarter_wave").requires_grad_(False)
    name = "surfaces.5.coating.thickness_1"
    at = dict(lens.named_parameters())[name].detach()

    def total(value):
        given = lens.with_values({name: value})
        return light_on_sensor(given, imaging, 0, [light(20, 40)], rays=80).sum()

    value = at.clone().requires_grad_()
    slope = float(torch.autograd.grad(total(value), value)[0])
    around = [float(total(at + step)) for step in (1e-2, -1e-2)]
    assert slope == pytest.approx((around[0] - around[1]) / 2e-2, rel=1e-5)


def test_a_photograph_has_its_lights(bare):
    dark = torch.full((3, 40, 60), 0.1)
    plain = bare.photograph(dark, distance=math.inf, light=None)
    veiled = bare.photograph(dark, distance=math.inf, light=None, lights=[])
    lit = bare.photograph(dark, distance=math.inf, light=None, lights=[(10, 45, 1e4)])
    assert bool((veiled.signal > plain.signal).all())
    assert divmod(int(lit.signal[1].argmax()), 60) == (10, 45)
    # Its ghosts are seen far from it.
    assert float((lit.signal - veiled.signal)[:, 20:, :30].amax()) > 0.01


@pytest.fixture(scope="module")
def starry():
    """A triplet at f/8 with six blades before pixels of two fringes, and a light of 10⁵."""
    lens = load_lens("cooke_triplet").with_iris(6, f_number=8).requires_grad_(False)
    fine = ImagingSystem.of(lens.system(), PlanarScene((FAR,), (GREEN,)), Sensor(81, 101, 0.009))
    return lens, fine


def test_a_starburst_moves_light_and_takes_none(starry):
    lens, fine = starry
    plain, star = (
        light_on_sensor(lens, fine, 0, [light(40, 50, 1e5)], rays=2000, diffraction=d)[0]
        for d in (False, True)
    )
    # What leaves the sensor: 2λN/(π²r) of a round stop, beyond 0.4 mm.
    assert float(star.sum() / plain.sum()) == pytest.approx(1.0, abs=5e-3)
    near = (slice(35, 46), slice(45, 56))
    assert float((plain[near].sum() - star[near].sum()) / plain.sum()) > 0.02


def test_waves_near_the_light_meet_the_edge_s_light_farther_out(starry):
    """The next ring of pixels outside of the window is as bright as its last, but for 1/r²."""
    lens, fine = starry
    star = starburst(lens.system(), fine.sensor, (0.0, 0.0, -FAR), GREEN, (537.0, 563.0), 1e5)
    size, outside = len(star.window), (star.rows - 40.0).abs().maximum((star.columns - 50.0).abs())
    half = size // 2
    ring = (outside > half + 0.5) & (outside < half + 1.5)
    last = float(star.window.sum() - star.window[1:-1, 1:-1].sum())
    fallen = (half / (half + 1.0)) ** 2
    assert float(star.light[ring].sum()) == pytest.approx(last * fallen, rel=0.05)
    assert float(star.window.sum() + star.light[outside > half + 0.5].sum()) == pytest.approx(
        1.0, abs=0.01
    )


def test_where_pixels_are_wide_rays_serve_as_well_as_waves(starry, monkeypatch):
    """Of a light between pixels of fifteen fringes; a twentieth of it leaves the brightest."""
    lens = starry[0]
    wide = ImagingSystem.of(lens.system(), PlanarScene((FAR,), (GREEN,)), Sensor(61, 61, 0.066))
    given = (lens, wide, 0, [light(30.4, 29.7, 1e5)], 2000)
    waves = light_on_sensor(*given)[0]
    monkeypatch.setattr("dolens.rendering.starburst._COARSE", 0.0)
    rays = light_on_sensor(*given)[0]
    assert not torch.equal(waves, rays)
    assert float((waves - rays).abs().sum() / rays.sum()) < 0.02


def test_a_round_stop_s_halo_falls_off_with_the_cube_of_the_distance():
    """The mean of Airy's rings, λN/(π³r³), over all azimuths, and smooth from pixel to pixel."""
    lens, pitch = hyperbola(50.0, 3.125), 0.02
    fine = ImagingSystem.of(lens.system(), PlanarScene((FAR,), (GREEN,)), Sensor(161, 161, pitch))
    own, ghosts_alone = (
        light_on_sensor(lens, fine, 0, [light(80, 80, 1e6)], rays=400, diffraction=d)[0]
        for d in (True, False)
    )
    at = torch.arange(-80.0, 81.0, dtype=torch.float64)
    r = pitch * torch.hypot(at[:, None], at)
    share = (own - ghosts_alone) / own.sum()
    for low, high in ((15, 20), (30, 40), (60, 78)):
        ring = (r > low * pitch) & (r < high * pitch)
        known = 1e-6 * GREEN * 8.0 * pitch**2 / (math.pi**3 * r[ring] ** 3)
        assert float(share[ring].sum() / known.sum()) == pytest.approx(1.0, abs=0.04)
        assert float((share[ring] / known).std()) < 0.15


def test_where_no_starburst_shows_nothing_changes(starry, caplog):
    lens, fine = starry
    caplog.set_level("INFO")
    both = [
        light_on_sensor(lens, fine, 0, [light(40, 50, 0.02)], rays=100, diffraction=d)
        for d in (False, True)
    ]
    assert torch.equal(*both)
    assert "starburst: left out: 0." in caplog.text


def test_a_colour_goes_half_way_to_the_next():
    assert bands((656.0, 588.0, 486.0)) == [(622.0, 690.0), (537.0, 622.0), (435.0, 537.0)]
    assert bands((550.0,)) == [(550.0, 550.0)]


def test_the_derivative_of_a_starburst_is_that_of_its_number(starry):
    lens, fine = starry
    name = "sensor_distance"
    at = dict(lens.named_parameters())[name].detach()
    away = torch.hypot(
        *torch.meshgrid(torch.arange(-40.0, 41.0), torch.arange(-50.0, 51.0), indexing="ij")
    )

    def spread(value):
        given = lens.with_values({name: value})
        image = light_on_sensor(given, fine, 0, [light(40, 50, 1e5)], rays=100)[0]
        return (image * away).sum()

    value = at.clone().requires_grad_()
    slope = float(torch.autograd.grad(spread(value), value)[0])
    around = [float(spread(at + step)) for step in (0.02, -0.02)]
    assert slope == pytest.approx((around[0] - around[1]) / 0.04, rel=0.03)


def test_lights_are_named_by_pixels_of_the_picture():
    (found,) = lights_of([(0, 0, 8.0)], (10, 20), Sensor(20, 40, 0.1))
    # Half a texel from the corner; one of its pixels is four of the sensor's.
    assert found == Light(0.5, 0.5, (32.0, 32.0, 32.0))
    (red,) = lights_of([(3, 4, 1.0, 0.5, 0.25)], (10, 20), Sensor(10, 20, 0.1))
    assert red == Light(3.0, 4.0, (1.0, 0.5, 0.25))


@pytest.mark.parametrize(
    ("lights", "message"),
    [
        ([(1, 2)], "number 1 is .*allowed: row, column, and the power"),
        ([(1, 2, 3), (1, 2, -3)], "number 2 is"),
        ([(1, 2, math.inf)], "number 1"),
        ([("a", 2, 3)], "number 1"),
        ([(10, 2, 3)], "row 10, column 2; allowed: within the picture of 10 × 20 pixels"),
    ],
)
def test_what_is_no_light_is_refused(lights, message):
    with pytest.raises(InputError, match=message):
        lights_of(lights, (10, 20), Sensor(10, 20, 0.1))
