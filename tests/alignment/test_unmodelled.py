"""What a measurement has and a fit's model has not: each effect against a closed form."""

import copy
import math

import pytest
import torch
import yaml

from dolens.alignment.image_losses import ImageMerit, NoiseWeightedLoss
from dolens.alignment.information import fisher_information
from dolens.alignment.measurement import Light, simulated
from dolens.alignment.pose import Pose
from dolens.alignment.unmodelled import Unmodelled, diffracted_light, unmodelled_of
from dolens.errors import InputError
from dolens.experiments.poses.fitting import Held, estimates, probability
from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.spot_image import SpotImager
from dolens.sensor.pixels import Sensor

WAVELENGTH, DISTANCE = 622.5, 864.0
PHOTONS = 60_000
SENSOR = Sensor(64, 64, 0.05)
SOURCE = torch.tensor([[0.0, 0.0, -DISTANCE]], dtype=torch.float64)


@pytest.fixture
def prescription(root):
    found = yaml.safe_load((root / "conf/lens/la1509.yaml").read_text())
    found["elements"] = {"lens": {"surfaces": [1, 2]}}
    return found


@pytest.fixture
def singlet(prescription):
    return lens_from_prescription(prescription).double().requires_grad_(False)


@pytest.fixture
def narrow(prescription):
    """The lens at F/50, which makes an image without aberrations."""
    for surface in prescription["surfaces"].values():
        surface["semi_diameter"] = 4.0
    prescription["surfaces"]["1"]["semi_diameter"] = 1.0
    return lens_from_prescription(prescription).double().requires_grad_(False)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def seen(lens, effects=None, photons=PHOTONS, read_noise=0.0, seed=0, sensor=SENSOR):
    return simulated(
        lens,
        SOURCE,
        WAVELENGTH,
        sensor,
        Light(photons, read_noise, unmodelled=effects or Unmodelled()),
        seeded(seed),
    )


def focus(lens):
    """From the last vertex to the paraxial image of the source, mm: two refractions."""
    n = float(lens.materials[1].index(WAVELENGTH))
    power = (n - 1.0) * float(lens.surfaces["1"].curvature)
    slope = 1.0 / DISTANCE - power  # n·u of a ray of height 1 behind the first surface
    height = 1.0 + float(lens.thicknesses["1"]) * slope / n
    return -height / slope


def variances(measurement):
    """Along x and y, mm²."""
    share = measurement.shares[0]
    sensor = measurement.sensor
    x, y = sensor.positions(torch.arange(sensor.height), torch.arange(sensor.width))
    cx, cy = measurement.centroid_of(share)
    return (share.sum(0) * (x - cx) ** 2).sum(), (share.sum(1) * (y - cy) ** 2).sum()


def test_without_effects_a_measurement_is_the_same_to_the_bit(singlet):
    plain, none = seen(singlet, read_noise=2.0), seen(singlet, Unmodelled(), read_noise=2.0)
    assert torch.equal(plain.images, none.images)
    assert not torch.equal(plain.images, seen(singlet, Unmodelled(background=1.0)).images)


@pytest.mark.parametrize("diffraction", [False, True])
def test_a_disc_widens_an_image_by_its_own_variance(narrow, diffraction):
    """By m²·d²/16 along each axis, with the movement m of the chief ray over that of the source."""
    with torch.no_grad():
        narrow.sensor_distance.fill_(118.0)
    diameter, n = 4.0, float(narrow.materials[1].index(WAVELENGTH))
    m = (float(narrow.thicknesses["1"]) / n + 118.0) / DISTANCE
    point = variances(seen(narrow, Unmodelled(diffraction=diffraction)))
    disc = variances(seen(narrow, Unmodelled(source_diameter=diameter, diffraction=diffraction)))
    for before, after in zip(point, disc, strict=True):
        # The marginal of a disc has the kurtosis 2: a sample's variance errs by 1/√N.
        expected = m**2 * diameter**2 / 16.0
        assert float(after - before) == pytest.approx(expected, rel=6.0 / math.sqrt(PHOTONS))


def test_background_is_light_with_shot_noise_in_every_pixel(narrow):
    """Mean and variance rise by b, to their standard errors times five."""
    dark, lit = seen(narrow), seen(narrow, Unmodelled(background=7.0))
    more = (lit.images - dark.images)[0]
    count = more.numel()
    assert float(more.mean()) == pytest.approx(7.0, abs=5.0 * math.sqrt(7.0 / count))
    error = math.sqrt((7.0 + 2.0 * 7.0**2) / count)
    assert float(more.var()) == pytest.approx(7.0, abs=5.0 * error)


def test_radii_and_indices_are_off_within_their_tolerances(singlet):
    """Uniform: the variance is a third of the tolerance's square; a plane stays one."""
    effects = Unmodelled(radius=0.002, index=5e-4)
    radii, indices = [], []
    for seed in range(300):
        made = effects.made(singlet, seeded(seed))
        nominal = float(singlet.surfaces["1"].curvature)
        radii.append(nominal / float(made.surfaces["1"].curvature) - 1.0)
        glass, air = made.materials[1], made.materials[2]
        indices.append(glass.index(WAVELENGTH) - singlet.materials[1].index(WAVELENGTH))
        assert float(made.surfaces["2"].curvature) == 0.0
        assert air.index(WAVELENGTH) == 1.0
        expected = 1.0 / (float(made.surfaces["1"].curvature) * (glass.index(WAVELENGTH) - 1.0))
        assert float(made.first_order(WAVELENGTH).efl) == pytest.approx(expected, rel=1e-12)
    for errors, tolerance in ((radii, 0.002), (indices, 5e-4)):
        off = torch.tensor(errors, dtype=torch.float64)
        assert float(off.abs().max()) <= tolerance * (1.0 + 1e-9)
        # Standard error of the mean square: √(4/45/300)·tolerance².
        assert float(off.square().mean()) == pytest.approx(tolerance**2 / 3.0, rel=0.26)
    assert float(singlet.surfaces["1"].curvature) == nominal


@pytest.mark.parametrize("effects", [{"index": 5e-3}, {"radius": 0.1}])
def test_a_lens_with_errors_has_its_focus_elsewhere(narrow, effects):
    """The spot's variance is (h/2)²·(1 - L/s')² with s' by paraxial formulas, L the sensor's
    place and h the beam's semi-diameter behind the lens.
    """
    made = Unmodelled(**effects).made(narrow, seeded(4))
    assert abs(focus(made) - focus(narrow)) > 0.3
    for lens in (narrow, made):
        place = focus(lens)
        n = float(lens.materials[1].index(WAVELENGTH))
        power = (n - 1.0) * float(lens.surfaces["1"].curvature)
        h = 1.0 + float(lens.thicknesses["1"]) * (1.0 / DISTANCE - power) / n
        with torch.no_grad():
            lens.sensor_distance.fill_(150.0)
        expected = (0.5 * h * (1.0 - 150.0 / place)) ** 2
        for found in variances(seen(lens, sensor=Sensor(256, 256, 0.005))):
            # Pixels add p²/12; a sample's variance of a disc errs by 1/√N, five times.
            found = float(found) - 0.005**2 / 12.0
            assert found == pytest.approx(expected, rel=5.0 / math.sqrt(PHOTONS) + 2e-3)


def test_diffraction_at_the_focus_is_airys(narrow):
    """Energy within the radius r is 1 - J0² - J1² of v = k·r·sin θ (Born and Wolf, 8.5.2)."""
    with torch.no_grad():
        narrow.sensor_distance.fill_(focus(narrow))
    sensor = Sensor(256, 256, 0.002)
    light = diffracted_light(narrow, SOURCE[0], WAVELENGTH, sensor)
    x, y = light.photons(400_000, 0.0, seeded())
    n = float(narrow.materials[1].index(WAVELENGTH))
    power = (n - 1.0) * float(narrow.surfaces["1"].curvature)
    sine = abs(1.0 / DISTANCE - power)
    for radius in (0.01, 0.02, 0.035, 0.06):
        v = torch.tensor(2.0 * math.pi / (WAVELENGTH * 1e-6) * radius * sine)
        expected = 1.0 - torch.special.bessel_j0(v) ** 2 - torch.special.bessel_j1(v) ** 2
        inside = float((torch.hypot(x, y) < radius).sum()) / 400_000
        assert inside == pytest.approx(float(expected), abs=0.006)


def test_diffraction_off_the_focus_has_the_fringes_of_a_disc(narrow):
    """On the axis the irradiance at δ from the focus is sinc²(δ·sin²θ/2λ) of that in it, and the
    image is as wide as that of rays where it is far off.
    """

    def middle(place):
        with torch.no_grad():
            narrow.sensor_distance.fill_(place)
        light = diffracted_light(narrow, SOURCE[0], WAVELENGTH, Sensor(128, 128, 0.004))
        row, column = light.y.abs().argmin(), light.x.abs().argmin()
        cell = float((light.x[1] - light.x[0]) * (light.y[1] - light.y[0]))
        return float(light.shares[row, column]) / cell

    best = focus(narrow)
    n = float(narrow.materials[1].index(WAVELENGTH))
    sine = abs(1.0 / DISTANCE - (n - 1.0) * float(narrow.surfaces["1"].curvature))
    at_focus = middle(best)
    for defocus in (3.0, 6.0):
        turns = 0.5 * defocus * sine**2 / (WAVELENGTH * 1e-6)
        expected = (math.sin(math.pi * turns) / (math.pi * turns)) ** 2
        assert middle(best + defocus) / at_focus == pytest.approx(expected, abs=0.01)


def test_waves_and_rays_agree_on_centroid_and_width(prescription):
    """Of a tilted lens: diffraction spreads an image by little, and shifts it not at all."""
    prescription["surfaces"]["1"]["semi_diameter"] = 5.0
    singlet = lens_from_prescription(prescription).double().requires_grad_(False)
    with torch.no_grad():
        singlet.elements["lens"].tilt_x.fill_(math.radians(3.0))
        singlet.elements["lens"].decenter_y.fill_(0.3)
    rays, waves = seen(singlet), seen(singlet, Unmodelled(diffraction=True), seed=1)
    for one, other, width in zip(
        *(m.centroid_of(m.shares[0]) for m in (rays, waves)), variances(rays), strict=True
    ):
        assert float(one - other) == pytest.approx(0.0, abs=6.0 * float(width / PHOTONS) ** 0.5)
    for one, other in zip(variances(rays), variances(waves), strict=True):
        assert float(other) == pytest.approx(float(one), rel=0.02)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radii": 0.1}, "unmodelled: unknown key 'radii'; did you mean 'radius'"),
        ({"radius": -0.1}, "unmodelled.radius: -0.1; allowed: from 0 to 0.5"),
        ({"index": 1.0}, "unmodelled.index: 1.0; allowed: from 0 to 0.2"),
        ({"background": -1.0}, "unmodelled.background: -1.0; allowed: 0 or more"),
        ({"source_diameter": math.inf}, "unmodelled.source_diameter: inf; allowed: 0 or more"),
        ({"diffraction": 1}, "unmodelled.diffraction: 1; allowed: true or false"),
    ],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        unmodelled_of(settings)


def test_light_spread_too_far_for_waves_is_an_error(singlet):
    with torch.no_grad():
        singlet.elements["lens"].tilt_x.fill_(math.radians(30.0))
    with pytest.raises(InputError, match="samples across the pupil, more than 3000"):
        seen(singlet, Unmodelled(diffraction=True), sensor=Sensor(128, 128, 0.0552))


def test_chances_of_chi_squared_are_those_of_two_degrees_of_freedom():
    chi = torch.tensor([0.0, 1.0, 9.21], dtype=torch.float64)
    torch.testing.assert_close(probability(chi, 2), torch.exp(-0.5 * chi))


def posed(lens, **initial):
    names = ("decenter_x", "decenter_y", "tilt_x", "tilt_y")
    settings = {f"elements.lens.{n}": {"initial": initial.get(n, 0.0)} for n in names}
    return Pose(copy.deepcopy(lens), SOURCE.tolist(), settings)


@pytest.mark.parametrize(
    "effects",
    [Unmodelled(radius=0.004), Unmodelled(source_diameter=0.2, diffraction=True)],
    ids=["radius", "source and diffraction"],
)
def test_estimates_end_where_a_fit_from_afar_does(singlet, effects):
    """Many bounds from the truth, with effects that the model lacks."""
    truth = {"tilt_x": 10.0, "tilt_y": 2.0, "decenter_x": 0.2, "decenter_y": 0.3}
    imager = SpotImager(SENSOR, WAVELENGTH, 30_000, rim=0.02, subpixels=1)
    one = posed(singlet, **truth)
    true = posed(singlet, **truth)
    true.store()
    made = effects.made(true.lens, seeded(3)) if effects.of_the_lens else true.lens
    measured = seen(made, effects, photons=300_000, read_noise=2.0)
    information = fisher_information(one, imager, seen(true.lens, photons=300_000, read_noise=2.0))
    names = {f"elements.lens.{n}": v for n, v in truth.items()}
    found = estimates(one, information, imager, lambda _: measured, [0], names)
    assert bool(found.settled)
    fit = posed(singlet, tilt_x=10.5, tilt_y=1.8, decenter_x=0.15, decenter_y=0.33)
    optimizer = DampedLeastSquares([fit.scaled], initial_damping=1e-6)
    chosen = torch.ones(4, dtype=torch.bool)
    for _ in range(6):
        loss = NoiseWeightedLoss(measured, imager).weighted_at(fit)
        optimizer.restart()
        optimizer.step(ImageMerit(loss, fit, chosen))
    bounds = information.bounds / one.units
    by_fit = torch.tensor(list(fit.file_values().values()), dtype=torch.float64)
    off = (by_fit - torch.tensor(list(names.values()), dtype=torch.float64)) / bounds
    far = float(off.abs().max())
    assert far > 5.0
    assert float(((found.values[0] - by_fit) / bounds).abs().max()) < max(0.2, 0.04 * far)
    assert float(found.chi_squared) > 50.0


def test_errors_of_what_is_held_have_no_part_in_an_images_own_chi_squared(singlet):
    """A held number that is off moves the estimate by the sensitivity, and by nothing else."""
    truth = {"tilt_x": 10.0, "decenter_y": 0.3}
    imager = SpotImager(SENSOR, WAVELENGTH, 20_000, rim=0.01, subpixels=1)
    one = posed(singlet, **truth)
    both = one.varying({**one.settings, "sensor_distance": None})
    true = posed(singlet, **truth)
    true.store()
    measured = seen(true.lens, photons=100_000, read_noise=2.0)
    alone = fisher_information(both, imager, measured).with_nuisance_parameters(
        4, torch.zeros(1, 1, dtype=torch.float64)
    )
    names = one.file_values()
    at = one.lens.sensor_distance.detach().reshape(1)
    unit = torch.ones(1, dtype=torch.float64)

    def found(off):
        held = Held(("sensor_distance",), unit, at, (at + off)[None], at)
        return estimates(one, alone, imager, lambda _: measured, [0], names, held)

    exact, moved = found(0.0), found(1e-4)
    torch.testing.assert_close(exact.chi_squared, moved.chi_squared, rtol=1e-6, atol=0.0)
    step = (moved.values - exact.values)[0] * one.units
    torch.testing.assert_close(step, 1e-4 * alone.nuisance_sensitivity[:, 0], rtol=1e-6, atol=1e-12)


def test_a_gradient_of_another_index_still_bends_light():
    # n + r2·r²: a rod of the focal length 1/(n·g·sin gL), g² = -2·r2/n.
    plane = {"type": "plane", "semi_diameter": 0.5}
    rod = {**plane, "thickness": 3.0, "material": "gradient 1.6 r2=-0.08"}
    rows = {"1": rod, "2": {**plane, "material": "air"}}
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 1.0}})
    made = Unmodelled(index=0.05).made(lens, torch.Generator().manual_seed(1))
    n = float(made.materials[1].index(550.0))
    g = math.sqrt(0.16 / n)
    assert abs(n - 1.6) > 1e-3
    known = 1.0 / (n * g * math.sin(3.0 * g))
    assert float(made.first_order(550.0).efl.detach()) == pytest.approx(known, rel=1e-12)
