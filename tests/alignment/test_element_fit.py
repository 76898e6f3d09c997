"""A misaligned element, found from moments of spots: derivatives, noise, and what is recovered."""

import math
from dataclasses import replace

import pytest
import torch

from dolens import InputError
from dolens.alignment.element_fit import (
    element_names,
    fit_element,
    information_root,
    least_covariance,
    moment_covariance,
    most_likely_element,
    simulated_moments,
)
from dolens.alignment.moments import POWERS, Pixels
from dolens.alignment.spot_moments import SENSOR, moment_model
from dolens.analysis.pupil_quadrature import gaussian_quadrature

FIELDS = ((0.0, 0.0), (0.0, 14.0), (-14.0, 0.0), (14.0, -6.0))
ELEMENTS = ("front", "middle", "rear")
HALF_RANGE = torch.tensor([math.radians(0.2)] * 2 + [0.05] * 2, dtype=torch.float64)
PIXELS = Pixels(0.00345, read_noise=2.0, window=5.0)


@pytest.fixture(scope="module")
def spots(triplet):
    return gaussian_quadrature(triplet, FIELDS, [587.5618], 3, 8, symmetry=False)


@pytest.fixture(scope="module")
def models(triplet, spots):
    return [moment_model(triplet, spots, element_names(triplet, name)) for name in ELEMENTS]


@pytest.fixture(scope="module")
def sensing(triplet, spots):
    """The same hypotheses of a lens whose sensor has pixels, and is somewhere."""
    return [
        moment_model(triplet, spots, element_names(triplet, name), SENSOR, PIXELS)
        for name in ELEMENTS
    ]


def with_sensor(pose, seed):
    """Poses (K, 7), the sensor within 0.02 mm of its place."""
    generator = torch.Generator().manual_seed(seed)
    place = torch.rand(len(pose), 3, generator=generator, dtype=torch.float64)
    return torch.cat([pose, 0.02 * (2.0 * place - 1.0)], 1)


def poses(count, seed):
    generator = torch.Generator().manual_seed(seed)
    return (2.0 * torch.rand(count, 4, generator=generator, dtype=torch.float64) - 1) * HALF_RANGE


@pytest.mark.parametrize("number", range(3))
def test_the_moments_are_those_of_the_lens_moved_by_hand(triplet, spots, models, number, moved):
    model, pose = models[number], poses(1, number)
    origin = model.centroids[None] + 0.01
    found = model.moments(pose, origin)[0]
    other = moved(triplet, dict(zip(model.names, pose[0].tolist(), strict=True)))
    points = other.trace(spots.rays).position.detach()[:, :2]
    for spot in range(spots.count):
        mine = spots.spot == spot
        x, y = ((points[mine] - origin[0, spot]) / model.size[spot]).unbind(-1)
        expected = torch.stack([(spots.weight[mine] * x**i * y**j).sum() for i, j in POWERS])
        torch.testing.assert_close(found[spot], expected, rtol=1e-9, atol=1e-9)


def test_a_moved_sensor_is_that_of_the_lens_moved_by_hand(triplet, spots, sensing, moved):
    model, truth = sensing[2], with_sensor(poses(1, 4), 4)
    errors = dict(zip(model.names[:4], truth[0, :4].tolist(), strict=True))
    other = moved(triplet, errors | {"sensor_distance": float(truth[0, 6])})
    # On a sensor that is 1 µm further to the right, light lands 1 µm further to the left.
    expected = other.trace(spots.rays).position.detach()[:, :2] - truth[0, 4:6]
    torch.testing.assert_close(model.points(truth)[0].T, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("kind", ["models", "sensing"])
@pytest.mark.parametrize("model_number", range(3))
def test_the_jacobian_against_central_differences(request, kind, model_number):
    model, pose = request.getfixturevalue(kind)[model_number], poses(2, 5)
    if kind == "sensing":
        pose = with_sensor(pose, 5)
    origin = (model.points(pose) @ model.shares).mT
    moments, jacobian = model.moments_and_jacobian(pose, origin)
    torch.testing.assert_close(moments, model.moments(pose, origin), rtol=1e-10, atol=1e-12)
    for p in range(pose.shape[1]):
        step = torch.zeros(pose.shape[1], dtype=torch.float64)
        step[p] = 1e-6
        slope = (model.moments(pose + step, origin) - model.moments(pose - step, origin)) / 2e-6
        scale = jacobian[..., p].abs().amax()
        assert float((slope - jacobian[..., p]).abs().amax()) < 1e-6 * float(scale)


def test_the_covariance_against_photons_drawn_one_by_one(models):
    model, pose, photons, trials = models[0], poses(1, 7), 50, 20000
    points = model.points(pose)
    origin = (points @ model.shares).mT
    covariance = moment_covariance(points, model.shares, origin, model.size, photons)[0]
    generator = torch.Generator().manual_seed(3)
    for spot in (0, 2):
        drawn = torch.multinomial(
            model.shares[:, spot], photons * trials, replacement=True, generator=generator
        )
        x, y = ((points[0, :, drawn] - origin[0, spot][:, None]) / model.size[spot]).unbind(0)
        values = torch.stack([x**i * y**j for i, j in POWERS])
        means = values.unflatten(-1, (trials, photons)).mean(-1)
        deviation = covariance[spot].diagonal().sqrt()
        difference = (torch.cov(means) - covariance[spot]) / torch.outer(deviation, deviation)
        # Sample covariances of 20000 scatter by about 1/√20000 = 0.7 %.
        assert float(difference.abs().max()) < 0.05


@pytest.mark.parametrize("kind", ["models", "sensing"])
def test_without_noise_every_element_is_named_and_its_pose_exact(request, kind):
    models, truth = request.getfixturevalue(kind), poses(3, 11)
    if kind == "sensing":
        truth = with_sensor(truth, 11)
    for number, model in enumerate(models):
        measured = simulated_moments(model, truth, 1e5, None)
        # A wrong hypothesis need not come to rest to be far off.
        fits = [fit_element(other, measured, 20 if other is model else 6) for other in models]
        named, share = most_likely_element([fit.chi_squared for fit in fits])
        assert named.tolist() == [number] * 3
        assert float(share[number].min()) > 1.0 - 1e-9
        assert bool(fits[number].converged.all())
        torch.testing.assert_close(fits[number].errors, truth, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("kind", ["models", "sensing"])
def test_chi_squared_has_its_degrees_of_freedom_and_errors_meet_their_bound(request, kind):
    model, count = request.getfixturevalue(kind)[2], 200
    truth = poses(1, 13) if kind == "models" else with_sensor(poses(1, 13), 13)
    truth = truth.expand(count, -1).clone()
    measured = simulated_moments(model, truth, 1e5, torch.Generator().manual_seed(1))
    fit = fit_element(model, measured)
    freedom = len(FIELDS) * len(POWERS) - truth.shape[1]
    # The mean of so many scatters by √(2·freedom/count); four times that.
    scatter = math.sqrt(2.0 * freedom / count)
    assert float(fit.chi_squared.mean()) == pytest.approx(freedom, abs=4.0 * scatter)
    root = information_root(model, measured[torch.tensor([0])], truth[:1])
    bound = least_covariance(root)[0].diagonal().sqrt()
    ratio = (fit.errors - truth).square().mean(0).sqrt() / bound
    assert float((ratio - 1.0).abs().max()) < 0.2


def test_the_bound_of_a_pose_grows_by_what_the_sensor_hides(triplet, spots, sensing):
    model, truth = sensing[0], with_sensor(poses(2, 15), 15)
    measured = simulated_moments(model, truth, 1e5, None)
    root = information_root(model, measured, truth)
    # Schur's complement: the information on a pose, less what goes into the sensor's place.
    information = root.mT @ root
    pose, both, place = information[:, :4, :4], information[:, :4, 4:], information[:, 4:, 4:]
    left = torch.linalg.inv(pose - both @ torch.linalg.solve(place, both.mT))
    scale = left.diagonal(dim1=1, dim2=2).sqrt()
    apart = (least_covariance(root)[:, :4, :4] - left) / (scale[:, :, None] * scale[:, None])
    assert float(apart.abs().max()) < 1e-6
    # With the sensor known, it is that of a model which has no such parameters.
    truth = torch.cat([truth[:, :4], torch.zeros(2, 3, dtype=torch.float64)], 1)
    root = information_root(model, measured, truth)
    alone = moment_model(triplet, spots, model.names[:4], (), PIXELS)
    torch.testing.assert_close(
        least_covariance(root[:, :4, :4]),
        least_covariance(information_root(alone, measured, truth[:, :4])),
        rtol=1e-6,
        atol=0.0,
    )
    hidden = least_covariance(root).diagonal(dim1=1, dim2=2)[:, :4]
    assert bool((hidden > least_covariance(root[:, :4, :4]).diagonal(dim1=1, dim2=2)).all())


def test_other_rays_of_the_same_pupil_have_nearly_the_same_moments(triplet, sensing):
    # Without vignetting both quadratures are all but exact; the unit must be one and the same.
    axis = [(0.0, 0.0)]
    few, many = (gaussian_quadrature(triplet, axis, [587.5618], *n, symmetry=False) for n in RAYS)
    names = element_names(triplet, "rear")
    fitted = moment_model(triplet, few, names, SENSOR, PIXELS)
    simulated = moment_model(triplet, many, names, SENSOR, PIXELS, fitted.size)
    truth = with_sensor(poses(3, 19), 19)
    measured = simulated_moments(simulated, truth, 1e5, None)
    found = fitted.moments(truth, measured.origin)
    assert float(measured.over_noise(found - measured.moments).abs().max()) < 0.1


RAYS = ((5, 12), (8, 20))


def test_the_origin_of_moments_does_not_matter(models):
    model, truth = models[1], poses(3, 17)
    points = model.points(truth)
    wrong = poses(3, 18)

    def chi_squared(origin):
        size, shares = model.size, model.shares
        covariance = moment_covariance(points, shares, origin, size, 1e5)
        difference = model.moments(wrong, origin) - model.moments(truth, origin)
        solved = torch.linalg.solve(covariance, difference[..., None])[..., 0]
        return (difference * solved).sum((-1, -2))

    origin = (points @ model.shares).mT
    torch.testing.assert_close(
        chi_squared(origin), chi_squared(origin + 0.5 * model.size[:, None]), rtol=1e-6, atol=0.0
    )


def test_bad_input_gives_one_clear_line(triplet, spots, models):
    with pytest.raises(InputError, match="no parameter 'elements"):
        element_names(triplet, "back")
    with pytest.raises(InputError, match="photons: 0"):
        simulated_moments(models[0], poses(1, 0), 0, None)
    with pytest.raises(InputError, match="lenses lose rays"):
        simulated_moments(models[0], poses(1, 0) * 500.0, 1e5, None)
    with pytest.raises(InputError, match="sensor: 'sensor_z' is unknown; did you mean 'sensor_y'"):
        moment_model(triplet, spots, element_names(triplet, "front"), ["sensor_z"])
    few = gaussian_quadrature(triplet, FIELDS[:1], [587.5618], 1, 4, symmetry=False)
    model = moment_model(triplet, few, element_names(triplet, "front"))
    with pytest.raises(InputError, match="too few rays"):
        simulated_moments(model, torch.zeros(1, 4), 1e5, None)
    mirrored = replace(few, centred=torch.ones_like(few.centred))
    with pytest.raises(InputError, match="whole pupil"):
        moment_model(triplet, mirrored, element_names(triplet, "front"))
