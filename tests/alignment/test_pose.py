"""Poses from images: losses, what can be known, measurements."""

import copy
import math
import struct
from zlib import crc32

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.alignment.image_losses import ImageMerit, ImageResiduals, NoiseWeightedLoss, SpotLoss
from dolens.alignment.information import FisherInformation, fisher_information
from dolens.alignment.measurement import (
    Light,
    Measurement,
    read_measurement,
    read_measurements,
    simulated,
)
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.rendering.spot_image import SpotImager
from dolens.sensor.pixels import Sensor

SENSOR = Sensor(48, 48, 0.1)
SOURCE = [[0.0, 0.0, -864.0]]
TILT, SHIFT = "elements.lens.tilt_x", "elements.lens.decenter_y"
ALL = ("decenter_x", "decenter_y", "shift_z", "tilt_x", "tilt_y")
IMAGER = SpotImager(SENSOR, 622.5, 40_000, subpixels=1)


def pose(lens, **initial):
    """All of a lens's pose, starting from these numbers (degrees, mm)."""
    settings = {f"elements.lens.{n}": {"initial": initial.get(n, 0.0)} for n in ALL}
    return Pose(copy.deepcopy(lens), SOURCE, settings)


def seen(lens, photons=400_000, read_noise=2.0, seed=0, sensor=SENSOR, **truth):
    """A simulated measurement of the lens in a pose."""
    true = pose(lens, **truth)
    true.store()
    generator = torch.Generator().manual_seed(seed)
    return simulated(true.lens, true.sources, 622.5, sensor, Light(photons, read_noise), generator)


def fitted(loss, fit, iterations=15):
    """By least squares."""
    chosen = torch.ones(len(fit.names), dtype=torch.bool)
    optimizer = DampedLeastSquares([fit.scaled])
    for _ in range(iterations):
        optimizer.step(lambda: ImageResiduals(loss, fit, chosen))
    return fit.file_values()


def test_degrees_outside_and_radians_inside(singlet):
    one = pose(singlet, tilt_x=3.0, shift_z=0.5)
    assert float(one()[TILT].detach()) == pytest.approx(math.radians(3.0))
    assert one.file_values()[TILT] == pytest.approx(3.0)
    one.store()
    assert float(one.lens.elements["lens"].tilt_x) == pytest.approx(math.radians(3.0))


def test_a_pose_is_bounded_and_linked_as_a_design_is(singlet):
    """Patterns name its variables; a fit keeps to bounds, which are degrees; a pickup follows."""
    settings = {
        "elements.lens.tilt_[xy]": {"lower": -1.0, "upper": 1.0},
        SHIFT: {"initial": 0.25},
        "elements.lens.decenter_x": {"pickup": SHIFT, "factor": -2.0},
    }
    one = Pose(copy.deepcopy(singlet), SOURCE, settings)
    assert list(one.names) == [TILT, "elements.lens.tilt_y", SHIFT]
    assert float(one()["elements.lens.decenter_x"].detach()) == -0.5
    loss = SpotLoss(seen(singlet, tilt_x=3.0), IMAGER, 1.0)
    optimizer = DampedLeastSquares([one.parameter_group()])
    chosen = torch.tensor([True, False, False])
    for _ in range(8):
        optimizer.step(lambda: ImageResiduals(loss, one, chosen))
    assert one.file_values()[TILT] == pytest.approx(1.0, abs=1e-12)
    again = one.varying(one.settings)
    assert again.file_values() == pytest.approx(one.file_values(), rel=1e-15)
    assert again.upper.tolist() == one.upper.tolist()
    again.store()
    assert float(again.lens.elements["lens"].decenter_x) == -0.5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sources.2.x": None}, "sources.<1 to 1>"),
        ({"sensor_distance": {"solve": "best_focus"}}, "of merit functions"),
        ({TILT: {"initial": 3.0, "upper": 2.0}}, "initial value 3 is outside its bounds"),
        ({TILT: {"size": 1.0}}, "unknown key 'size'"),
        ({TILT: {"scale": 0.0}}, "scale must be positive"),
    ],
)
def test_bad_variables_are_errors(singlet, settings, message):
    with pytest.raises(InputError, match=message):
        Pose(singlet, SOURCE, settings)


def test_simulation_and_model_agree_to_their_noise(singlet):
    """Photons counted by other code, with sharp rims and square pixels: χ² of a pixel is near 1."""
    truth = {"tilt_x": 8.0, "tilt_y": -3.0, "decenter_y": 0.4, "shift_z": -1.0}
    measured = seen(singlet, 300_000, **truth)
    with torch.no_grad():
        (image,) = pose(singlet, **truth).images(SpotImager(SENSOR, 622.5, 400_000, subpixels=4))
    expected = float(measured.totals[0]) * image.image
    bright = expected > 20.0
    chi = (measured.images[0] - expected).square() / (expected + 4.0)
    assert float(chi[bright].mean()) == pytest.approx(1.0, abs=0.25)
    assert torch.allclose(measured.centroids()[0], image.centroid, atol=2e-3)


@pytest.mark.parametrize("weighted", [False, True])
def test_jacobians_are_those_of_differences(singlet, weighted):
    measured = seen(singlet, tilt_x=2.0)
    one = pose(singlet, tilt_x=1.0, decenter_y=0.1)
    loss = SpotLoss(measured, IMAGER, 1.0, blur=1.0)
    chosen = torch.tensor([True, True, True, True, weighted])
    if weighted:
        loss = NoiseWeightedLoss(measured, IMAGER).weighted_at(one)
    residuals, jacobian = loss.jacobian(one, chosen)
    point, h = one.scaled.detach(), 1e-6
    assert torch.allclose(residuals, loss.residuals(one).detach())
    assert not bool(jacobian[:, ~chosen].any())
    for number in chosen.nonzero().flatten().tolist():
        step = torch.zeros_like(point)
        step[number] = h
        with torch.no_grad():
            ahead, behind = (loss.residuals(one, point + s) for s in (step, -step))
        difference = (ahead - behind) / (2.0 * h)
        apart = (jacobian[:, number] - difference).abs().max()
        assert float(apart) < 1e-4 * float(difference.abs().max())


def test_without_centroids_a_fit_of_spots_apart_stagnates_and_with_them_it_does_not(singlet):
    """S21's reason: where spots do not overlap the squared error of images has no slope."""
    sharp = copy.deepcopy(singlet)
    with torch.no_grad():
        sharp.sensor_distance.fill_(112.0)
    measured = seen(sharp, read_noise=0.0, decenter_y=1.5)
    errors = {}
    for weight in (0.0, 1.0):
        one = Pose(copy.deepcopy(sharp), SOURCE, {SHIFT: None})
        loss = SpotLoss(measured, IMAGER, weight)
        with torch.no_grad():
            (image,) = one.images(IMAGER)
        assert not bool(((image.image > 0.0) & (measured.images[0] > 0.0)).any())
        errors[weight] = abs(fitted(loss, one)[SHIFT] - 1.5)
    assert errors[0.0] > 1.4
    assert errors[1.0] < 0.003


def test_a_pose_is_found_within_a_few_of_its_bounds(singlet):
    truth = {"tilt_x": 10.0, "tilt_y": 2.0, "decenter_x": 0.2, "decenter_y": 0.3, "shift_z": -0.5}
    measured = seen(singlet, 1_000_000, **truth)
    one = pose(singlet, tilt_x=9.0)
    found = fitted(SpotLoss(measured, IMAGER, 1.0), one, 12)
    bounds = fisher_information(one, IMAGER, measured).bounds / one.units
    for name, bound in zip(one.names, bounds.tolist(), strict=True):
        assert abs(found[name] - truth[name.rpartition(".")[2]]) < 10.0 * bound


def test_the_bound_is_that_of_many_simulated_estimates(singlet):
    """Photons drawn anew 200 times: spread over bound is 1 to its standard error, 0.05, and 95 %
    intervals about the estimates' mean hold 95 % of them.
    """
    truth = {"tilt_x": 10.0, "decenter_y": 0.3}
    one = pose(singlet, **truth)
    measured = seen(singlet, 100_000, **truth)
    information = fisher_information(one, SpotImager(SENSOR, 622.5, 200_000, subpixels=2), measured)
    generator = torch.Generator().manual_seed(1)
    images = torch.poisson(information.expected.clamp(min=0.0).expand(200, -1, -1, -1), generator)
    images = images + 2.0 * torch.randn(images.shape, generator=generator, dtype=torch.float64)
    found = torch.stack(
        [information.correction(Measurement(image, measured.mask, 2.0, SENSOR)) for image in images]
    )
    ratio = found.std(0) / information.bounds
    assert float((ratio - 1.0).abs().max()) < 4.0 / math.sqrt(2.0 * 200.0)
    within = ((found - found.mean(0)).abs() < 1.96 * information.bounds).double().mean(0)
    assert float((within - 0.95).abs().max()) < 0.06


def test_information_grows_with_light_and_with_sources(singlet):
    """Four times the photons halve a bound that shot noise sets; a second source adds its own."""
    one = pose(singlet, tilt_x=10.0)
    few = Measurement(*_flat(1, 1e5), 0.0, SENSOR)
    many = Measurement(*_flat(1, 4e5), 0.0, SENSOR)
    ratio = (
        fisher_information(one, IMAGER, few).bounds / fisher_information(one, IMAGER, many).bounds
    )
    assert torch.allclose(ratio, torch.full_like(ratio, 2.0), rtol=1e-3)
    names = {f"elements.lens.{n}": {"initial": 10.0 if n == "tilt_x" else 0.0} for n in ALL}
    two = Pose(singlet, [*SOURCE, [150.0, 0.0, -864.0]], names)
    wide = SpotImager(Sensor(96, 96, 0.5), 622.5, 20_000, subpixels=1)
    alone = Pose(singlet, SOURCE, names)
    sensor = wide.sensor
    first = fisher_information(alone, wide, Measurement(*_flat(1, 1e5, sensor), 0.0, sensor)).bounds
    both = fisher_information(two, wide, Measurement(*_flat(2, 1e5, sensor), 0.0, sensor)).bounds
    assert bool((both < first).all())


def test_what_cannot_be_seen_has_a_bound_beyond_all_measure():
    """Two numbers of which images show only the sum, and a third that they do not show."""
    weighted = torch.tensor([[3.0, 3.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]).double()
    information = FisherInformation(("a", "b", "c"), weighted, weighted, weighted)
    assert bool((information.bounds > 1e5).all())
    assert float(information.correlations[0, 1]) == pytest.approx(-1.0)
    spread, eigenvectors = information.eigenvectors(torch.ones(3, dtype=torch.float64))
    assert spread.tolist()[2] == pytest.approx(1.0 / math.sqrt(20.0))
    assert eigenvectors[2].abs().tolist() == pytest.approx([0.5**0.5, 0.5**0.5, 0.0], abs=1e-9)
    assert float(spread[1]) > 1e6


def _flat(count, total, sensor=SENSOR):
    """Images whose totals alone count, and a mask of ones."""
    shape = (count, sensor.height, sensor.width)
    images = torch.full(shape, total / (sensor.height * sensor.width), dtype=torch.float64)
    return images, torch.ones(shape, dtype=torch.bool)


def test_a_photograph_is_read_with_its_dark_level_region_and_saturation(tmp_path):
    counts = np.full((40, 60), 100, np.uint16)
    counts[10:14, 20:24] = 1100
    counts[12, 30] = 65535
    Image.fromarray(counts).save(tmp_path / "spot.tif")
    found = read_measurement(
        tmp_path / "spot.tif",
        0.01,
        dark_level=100.0,
        region=(8, 16, 20, 24),
        downsample=2,
        electrons_per_count=0.5,
        read_noise=3.0,
    )
    assert found.images.shape == (1, 10, 12)
    assert found.read_noise == 6.0
    assert found.sensor.pixel_pitch == 0.02
    # 16 bright pixels of 1000 counts above the dark, half an electron each.
    assert float(found.totals[0]) == pytest.approx(8000.0)
    assert int((~found.mask).sum()) == 1
    # The patch's middle is at row 11.5, column 21.5 of 40 × 60; images are upside down.
    assert found.centroids()[0].tolist() == pytest.approx(
        [(29.5 - 21.5) * 0.01, (11.5 - 19.5) * 0.01]
    )


def bomb():
    """A few bytes of a PNG that mean ten thousand million pixels."""
    size = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", size), (b"IDAT", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", crc32(name + data))
        for name, data in chunks
    )


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: p.write_bytes(b"none"), "cannot be decoded"),
        (lambda p: p.write_bytes(b"P5 60000 60000 255\n"), "raw values cannot be read from PPM"),
        (lambda p: p.write_bytes(bomb()), "100000×100000 are 10000 million pixels"),
        (lambda p: Image.new("RGB", (4, 4)).save(p), "one channel of integers"),
    ],
)
def test_a_file_that_is_no_photograph_is_an_error(tmp_path, write, message):
    write(tmp_path / "spot.png")
    with pytest.raises(InputError, match=message):
        read_measurement(tmp_path / "spot.png", 0.01)


def test_light_beyond_the_edge_is_missing_from_both(singlet):
    """A spot that the sensor cuts is compared with the light that falls on it, not with all."""
    small = Sensor(16, 16, 0.1)
    measured = seen(singlet, 2_000_000, read_noise=0.0, sensor=small, tilt_x=10.0)
    imager = SpotImager(small, 622.5, 200_000, subpixels=2)
    with torch.no_grad():
        (image,) = pose(singlet, tilt_x=10.0).images(imager)
    shares, centroid = measured.as_seen(image, 0)
    assert float(image.image.sum()) < 0.9
    assert float(shares.sum()) == pytest.approx(1.0, rel=1e-12)
    assert float((shares - measured.shares[0]).abs().max() / shares.max()) < 0.05
    assert torch.allclose(centroid, measured.centroids()[0], atol=2e-3)


# ---------------------------------------------------------------- weighted by noise


def test_weighted_by_noise_a_fit_has_errors_of_its_bounds(singlet):
    """Of 8 measurements with other photons: the RMS of error over bound is 1 to its standard
    error, 1/√(2·8·5) = 0.11, times three; χ² of a pixel is 1.
    """
    truth = {"tilt_x": 10.0, "tilt_y": 2.0, "decenter_x": 0.2, "decenter_y": 0.3, "shift_z": -0.5}
    fine = SpotImager(SENSOR, 622.5, 30_000, rim=0.004, subpixels=5)
    ratios = []
    for seed in range(8):
        measured = seen(singlet, 60_000, seed=seed, **truth)
        one = pose(singlet, **truth)
        found = weighted_fit(one, fine, measured, 2)
        loss = NoiseWeightedLoss(measured, fine)
        assert float(loss.residuals(one).square().sum()) == pytest.approx(1.0, abs=0.12)
        bounds = fisher_information(one, fine, measured).bounds / one.units
        ratios += [
            (found[name] - truth[name.rpartition(".")[2]]) / float(bound)
            for name, bound in zip(one.names, bounds, strict=True)
        ]
    assert float(torch.tensor(ratios).square().mean().sqrt()) == pytest.approx(1.0, abs=0.33)


def weighted_fit(one, imager, measured, iterations=3):
    """By least squares with weights that follow the pose."""
    chosen = torch.ones(len(one.names), dtype=torch.bool)
    optimizer = DampedLeastSquares([one.scaled], initial_damping=1e-6)
    for _ in range(iterations):
        loss = NoiseWeightedLoss(measured, imager).weighted_at(one)
        optimizer.restart()
        optimizer.step(ImageMerit(loss, one, chosen))
    return one.file_values()


def test_a_held_number_that_is_off_moves_the_fit_by_what_was_foretold(singlet):
    """And its variance goes into the bound: the sensor's distance held 0.05 mm too far."""
    truth = {"tilt_x": 10.0, "decenter_y": 0.3}
    fine = SpotImager(SENSOR, 622.5, 100_000, rim=0.002, subpixels=8)
    measured = seen(singlet, 400_000, **truth)
    right, wrong = pose(singlet, **truth), pose(singlet, **truth)
    wrong.lens.sensor_distance.add_(0.05)
    moved = [weighted_fit(one, fine, measured, 3) for one in (right, wrong)]
    names = {n: {"initial": v} for n, v in moved[0].items()}
    both = Pose(right.lens, SOURCE, {**names, "sensor_distance": None})
    variance = torch.tensor([[0.05**2]], dtype=torch.float64)
    information = fisher_information(both, fine, measured).with_nuisance_parameters(5, variance)
    foretold = (0.05 * information.nuisance_sensitivity[:, 0] / right.units).tolist()
    for name, expected in zip(information.names, foretold, strict=True):
        slack = 0.1 * max(abs(expected), float(information.bounds.min()))
        assert moved[1][name] - moved[0][name] == pytest.approx(expected, abs=slack)
    added = information.covariance - information.own_covariance
    wanted = information.nuisance_sensitivity @ variance @ information.nuisance_sensitivity.T
    apart = (added - wanted) / torch.outer(information.bounds, information.bounds)
    assert float(apart.abs().max()) < 1e-9
    assert bool((information.bounds > information.own_covariance.diagonal().sqrt()).all())


def test_a_second_plane_is_the_sensor_moved(singlet):
    """Its images are those of a sensor there, and tell source from sensor distance."""
    names = {"sensor_distance": None, "sources.1.z": {"scale": 50.0}}
    two = Pose(singlet, SOURCE, names, planes=[0.0, -2.0])
    near = copy.deepcopy(singlet)
    near.sensor_distance.add_(-2.0)
    with torch.no_grad():
        images = two.images(IMAGER)
        (alone,) = Pose(near, SOURCE, {}).images(IMAGER)
    assert torch.equal(images[1].image, alone.image)
    measured = simulated(
        singlet,
        two.sources,
        622.5,
        SENSOR,
        Light(400_000),
        torch.Generator().manual_seed(0),
        two.planes,
    )
    assert measured.images.shape == (2, 48, 48)
    assert torch.allclose(measured.centroids()[1], images[1].centroid, atol=5e-3)
    both = fisher_information(two, IMAGER, measured)
    first = Measurement(measured.images[:1], measured.mask[:1], 2.0, SENSOR)
    one = fisher_information(Pose(singlet, SOURCE, names), IMAGER, first)
    # Twice the light alone would make it 0.7 of the bound.
    assert bool((both.bounds < 0.55 * one.bounds).all())
    with pytest.raises(InputError, match="planes: none is given"):
        Pose(singlet, SOURCE, names, planes=[])


def test_sources_shift_as_one_target(singlet):
    """By a variable of their own, once however often it is put."""
    names = {"sources.*.x": {"initial": 0.5}, "sources.2.z": None}
    two = Pose(singlet, [[0.0, 0.0, -864.0], [3.0, 1.0, -700.0]], names)
    assert two.file_values() == {"sources.*.x": 0.5, "sources.2.z": -700.0}
    for _ in range(2):
        two.put({"sources.*.x": 0.5, "sources.2.z": -710.0})
    assert two.places.tolist() == [[0.5, 0.0, -864.0], [3.5, 1.0, -710.0]]
    other = two.varying({"sources.*.x": None})
    assert other.file_values() == {"sources.*.x": 0.5}
    given = Pose(singlet, [[0.5, 0.0, -864.0], [3.5, 1.0, -710.0]], {})
    with torch.no_grad():
        pairs = zip(other.images(IMAGER), given.images(IMAGER), strict=True)
        for shifted, image in pairs:
            assert torch.equal(shifted.image, image.image)


def test_photographs_of_several_sources_are_one_of_each_and_alike(tmp_path):
    rows = np.arange(16, dtype=np.uint16)
    for number in range(2):
        Image.fromarray(np.add.outer(rows, (number + 1) * rows)).save(tmp_path / f"{number}.png")
    entries = [{"path": tmp_path / f"{number}.png", "pixel_pitch": 0.01} for number in range(2)]
    both = read_measurements(entries, 2)
    assert both.images.shape == (2, 16, 16)
    assert torch.equal(both.images[1], read_measurement(**entries[1]).images[0])
    with pytest.raises(InputError, match="1 photographs; allowed: 2"):
        read_measurements(entries[0], 2)
    with pytest.raises(InputError, match="differ in their pixels"):
        read_measurements([entries[0], {**entries[1], "pixel_pitch": 0.02}], 2)


def test_blurred_residuals_have_the_covariance_that_is_said_and_a_chi_squared_near_one(singlet):
    """Noise drawn 400 times through `correction`: its spread is that of `own_covariance`, to four
    standard errors, and no less than the bound without a blur.
    """
    truth = {"tilt_x": 10.0, "decenter_y": 0.3}
    one = pose(singlet, **truth)
    measured = seen(singlet, 100_000, **truth)
    information = fisher_information(one, IMAGER, measured, blur=1.0)
    generator = torch.Generator().manual_seed(1)
    found = []
    for _ in range(400):
        noise = torch.randn(information.noise.shape, generator=generator, dtype=torch.float64)
        image = information.expected + information.noise * noise
        found.append(information.correction(Measurement(image, measured.mask, 2.0, SENSOR)))
    ratio = torch.stack(found).std(0) / information.bounds
    assert float((ratio - 1.0).abs().max()) < 4.0 / math.sqrt(800.0)
    assert bool(
        (information.bounds > 0.99 * fisher_information(one, IMAGER, measured).bounds).all()
    )
    # Source, lens and sensor that move along the axis together cannot be seen, blurred or not.
    along = {"sensor_distance": None, "sources.1.z": None, "elements.lens.shift_z": None}
    unseen = fisher_information(one.varying(along), IMAGER, measured, blur=1.0)
    assert bool((unseen.bounds > 1e3).all())
    fine = SpotImager(SENSOR, 622.5, 100_000, rim=0.002, subpixels=8)
    loss = NoiseWeightedLoss(measured, fine, blur=1.0)
    assert float(loss.residuals(one).square().sum()) == pytest.approx(1.0, abs=0.2)
