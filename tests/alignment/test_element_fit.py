"""A misaligned element, found from moments of spots: derivatives, noise, and what is recovered."""

import math
from dataclasses import replace

import pytest
import torch
import yaml

from dolens import InputError
from dolens.alignment.element_fit import bounds, element_names, fit_element, named_element
from dolens.alignment.moment_noise import (
    POWERS,
    moment_covariance,
    moment_model,
    simulated_moments,
)
from dolens.imaging.spot_rays import gaussian_quadrature
from dolens.prescriptions import lens_from_prescription

FIELDS = ((0.0, 0.0), (0.0, 14.0), (-14.0, 0.0), (14.0, -6.0))
ELEMENTS = ("front", "middle", "rear")
HALF_RANGE = torch.tensor([math.radians(0.2)] * 2 + [0.05] * 2, dtype=torch.float64)


@pytest.fixture(scope="module")
def triplet(root):
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    spans = {"front": [1, 2], "middle": [3, 4], "rear": [5, 6]}
    prescription["elements"] = {name: {"surfaces": span} for name, span in spans.items()}
    return lens_from_prescription(prescription, torch.float64)


@pytest.fixture(scope="module")
def spots(triplet):
    return gaussian_quadrature(triplet, FIELDS, [587.5618], 3, 8, symmetry=False)


@pytest.fixture(scope="module")
def models(triplet, spots):
    return [moment_model(triplet, spots, element_names(triplet, name)) for name in ELEMENTS]


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


@pytest.mark.parametrize("model_number", range(3))
def test_the_jacobian_against_central_differences(models, model_number):
    model, pose = models[model_number], poses(2, 5)
    origin = (model.points(pose) @ model.shares).mT
    moments, jacobian = model.moments_and_jacobian(pose, origin)
    torch.testing.assert_close(moments, model.moments(pose, origin), rtol=1e-10, atol=1e-12)
    for p in range(4):
        step = torch.zeros(4, dtype=torch.float64)
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


def test_without_noise_every_element_is_named_and_its_pose_exact(models):
    truth = poses(3, 11)
    for number, model in enumerate(models):
        measured = simulated_moments(model, truth, 1e5, None)
        # A wrong hypothesis need not come to rest to be far off.
        fits = [fit_element(other, measured, 20 if other is model else 3) for other in models]
        named, share = named_element([fit.chi_squared for fit in fits])
        assert named.tolist() == [number] * 3
        assert float(share[number].min()) > 1.0 - 1e-9
        assert bool(fits[number].converged.all())
        torch.testing.assert_close(fits[number].errors, truth, rtol=0.0, atol=1e-8)


def test_chi_squared_has_its_degrees_of_freedom_and_errors_meet_their_bound(models):
    model, count = models[2], 200
    truth = poses(1, 13).expand(count, 4).clone()
    measured = simulated_moments(model, truth, 1e5, torch.Generator().manual_seed(1))
    fit = fit_element(model, measured)
    freedom = len(FIELDS) * len(POWERS) - 4
    # The mean of so many scatters by √(2·freedom/count); four times that.
    scatter = math.sqrt(2.0 * freedom / count)
    assert float(fit.chi_squared.mean()) == pytest.approx(freedom, abs=4.0 * scatter)
    bound = bounds(model, measured[torch.tensor([0])], truth[:1])[0].diagonal().sqrt()
    ratio = (fit.errors - truth).square().mean(0).sqrt() / bound
    assert float((ratio - 1.0).abs().max()) < 0.2


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
    few = gaussian_quadrature(triplet, FIELDS[:1], [587.5618], 1, 4, symmetry=False)
    model = moment_model(triplet, few, element_names(triplet, "front"))
    with pytest.raises(InputError, match="too few rays"):
        simulated_moments(model, torch.zeros(1, 4), 1e5, None)
    mirrored = replace(few, centred=torch.ones_like(few.centred))
    with pytest.raises(InputError, match="whole pupil"):
        moment_model(triplet, mirrored, element_names(triplet, "front"))
