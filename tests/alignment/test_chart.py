"""Photographs of a chart: its marks, the light of them, and the fit of a camera to them."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from torch.func import jacfwd

import dolens
from dolens.alignment.chart import Chart, on_sensor
from dolens.alignment.chart_fit import Prior, fit_chart
from dolens.alignment.chart_model import ChartModel, ChartRays
from dolens.alignment.chart_photons import ChartLight, TrueCamera, _on_tilted_plane, photographed
from dolens.alignment.gaussian_filters import orders, smoothed_weights, weights_on_grid
from dolens.errors import InputError
from dolens.optics.elements import Element
from dolens.optics.lens import Lens

PITCH = 0.00345
DEG = math.pi / 180.0


def triplet() -> Lens:
    lens = dolens.load_lens("conf/lens/cooke_triplet.yaml", dtype=torch.float64)
    for name, surfaces in (("front", (1, 2)), ("middle", (3, 4)), ("rear", (5, 6))):
        lens.elements[name] = Element(*surfaces)
    return lens.requires_grad_(False)


def test_points_of_marks_have_the_moments_of_a_disc_and_of_a_square():
    """⟨x²⟩ = r²/4 and ⟨x⁴⟩ = r⁴/8 of a disc; a²/12, and a⁴/80 of a square whose sides lie along."""
    disc, square = (
        Chart(1000.0, 1, 1, 10.0, 2.0, shape, angle=0.0).quadrature()
        for shape in ("disc", "square")
    )
    for (points, shares), second, fourth in ((disc, 0.25, 0.125), (square, 1 / 3, 0.2)):
        x, y = points.T
        assert float(shares.sum()) == pytest.approx(1.0, abs=1e-15)
        assert float((shares * x).sum()) == pytest.approx(0.0, abs=1e-15)
        for axis in (x, y):
            assert float((shares * axis**2).sum()) == pytest.approx(second, rel=1e-12)
            assert float((shares * axis**4).sum()) == pytest.approx(fourth, rel=1e-12)
    turned, _ = Chart(1000.0, 1, 1, 10.0, 2.0, "square", angle=90.0).quadrature()
    assert torch.allclose(turned, torch.stack([-square[0][:, 1], square[0][:, 0]], -1), atol=1e-15)


def test_a_chart_s_numbers_are_refused_by_name():
    with pytest.raises(InputError, match=r"chart.size: 20.*less than pitch"):
        Chart(1000.0, 2, 2, 10.0, 20.0)
    with pytest.raises(InputError, match=r"chart.rows: 0"):
        Chart(1000.0, 0, 2, 10.0, 1.0)


def test_light_on_a_tilted_sensor_and_its_derivatives():
    """Closed forms agree with automatic ones, and with rays that are turned into its axes."""
    generator = torch.Generator().manual_seed(3)
    crossing = 8.0 * torch.randn(5, 2, generator=generator, dtype=torch.float64)
    tangent = 0.3 * torch.randn(5, 2, generator=generator, dtype=torch.float64)
    pose = torch.tensor([0.1, -0.2, 0.03, -0.05], dtype=torch.float64)
    found = on_sensor(crossing, tangent, pose, 0.7)
    for row in range(5):

        def land(point, slope, numbers):
            return on_sensor(point, slope, numbers, 0.7).points

        by_point, by_tangent, by_pose = jacfwd(land, argnums=(0, 1, 2))(
            crossing[row], tangent[row], pose
        )
        assert torch.allclose(found.by_point[row], by_point, atol=1e-12)
        assert torch.allclose(found.by_tangent[row], by_tangent, atol=1e-12)
        assert torch.allclose(found.by_pose[row, :, :4], by_pose, atol=1e-12)
    ahead, behind = (on_sensor(crossing, tangent, pose, 0.7 + d).points for d in (1e-6, -1e-6))
    assert torch.allclose(found.by_pose[..., 4], (ahead - behind) / 2e-6, atol=1e-8)

    lens = triplet()
    depth = float(sum(lens.thicknesses.values()) + lens.sensor_distance)
    camera = TrueCamera(lens, tuple(pose.tolist()), (0.0,) * 6, 0.0, 0.0, (0.7,))
    position = torch.cat([crossing, torch.full((5, 1), depth, dtype=torch.float64)], 1)
    way = torch.cat([tangent, torch.ones(5, 1, dtype=torch.float64)], 1)
    way = way / way.norm(dim=-1, keepdim=True)
    turned = _on_tilted_plane(position, way, torch.ones(5, dtype=torch.bool), camera, 0.7)
    assert torch.allclose(found.points, turned, atol=1e-12)


def test_derivatives_of_gaussians_convolved_by_closed_form_and_by_a_sum():
    width, variance = torch.tensor(0.01).double(), torch.tensor(3e-5).double()
    grid = torch.linspace(-0.09, 0.09, 721, dtype=torch.float64)
    along, down = weights_on_grid(grid, grid, width, 4)
    points = torch.tensor([[0.004, -0.007], [0.0, 0.002]], dtype=torch.float64)
    found, slope, spread = smoothed_weights(points, width, variance, 4)
    assert found.shape == (2, len(orders(4))) == (2, 15)
    for row, (x, y) in enumerate(points):
        gauss_x, gauss_y = (torch.exp(-0.5 * (grid - c) ** 2 / variance) for c in (x, y))
        area = float(grid[1] - grid[0]) ** 2 / (2.0 * math.pi * float(variance))
        summed = (along @ gauss_x) * (down @ gauss_y) * area
        assert torch.allclose(found[row], summed, atol=1e-9)
    for axis in (0, 1):
        step = torch.zeros(2, dtype=torch.float64)
        step[axis] = 1e-6
        ahead, behind = (
            smoothed_weights(points + s * step, width, variance, 4)[0] for s in (1, -1)
        )
        assert torch.allclose(slope[..., axis], (ahead - behind) / 2e-6, atol=1e-4)
    ahead, behind = (smoothed_weights(points, width, variance + s * 1e-9, 4)[0] for s in (1, -1))
    assert torch.allclose(spread, (ahead - behind) / 2e-9, rtol=1e-6, atol=1e-2)


NAMES = ("elements.middle.decenter_x", "elements.rear.tilt_y", "thicknesses.2", "sensor_distance")


def small_model(rings=6, arms=24, planes=(2.4, 2.8), names=NAMES) -> ChartModel:
    chart = Chart(1000.0, 2, 3, 150.0, 0.2)
    return ChartModel(ChartRays(triplet(), chart, (587.5618,), rings, arms), names, planes, PITCH)


def test_rays_and_their_light_have_the_derivatives_of_clipped_beams():
    """Central differences, with the rims of each lens found anew; the chart moves too."""
    model = small_model(3, 8)
    numbers = model.designed
    landed, slopes = model.landed_derivatives(numbers)
    assert torch.equal(landed, model.landed(numbers))
    for name in (*NAMES, "chart.x", "chart.tilt_y", "mark_size"):
        step = torch.zeros_like(numbers)
        step[model.names.index(name)] = 1e-5
        difference = (model.landed(numbers + step) - model.landed(numbers - step)) / 2e-5
        own = slopes[..., model.names.index(name)]
        for row in range(5):
            assert torch.allclose(own[row], difference[row], rtol=1e-4, atol=1e-6), (name, row)


def test_rays_have_the_light_and_the_spread_of_photons_with_sharp_rims():
    """Means and widths of a tilted camera's marks agree with 200 000 photons each."""
    model = small_model()
    numbers = model.designed
    true = {
        "elements.middle.decenter_x": 0.05,
        "elements.rear.tilt_y": 0.2 * DEG,
        "sensor.tilt_x": 0.3 * DEG,
        "sensor.y": 0.05,
        "chart.tilt_y": 0.5 * DEG,
        "chart.x": 1.0,
        "blur": 4e-6,
    }
    for name, value in true.items():
        numbers[model.names.index(name)] = value
    lens = copy.deepcopy(model.rays.lens)
    lens.elements["middle"].decenter_x.fill_(0.05)
    lens.elements["rear"].tilt_y.fill_(0.2 * DEG)
    camera = TrueCamera(
        lens,
        (0.0, 0.05, 0.3 * DEG, 0.0),
        (1.0, 0.0, 0.0, 0.0, 0.5 * DEG, 0.0),
        0.0,
        4e-6,
        model.planes,
    )
    centres, widths = model.spots(numbers, model.landed(numbers))
    side = 121
    corners = torch.round(centres / PITCH) * PITCH - (side // 2) * PITCH
    light = ChartLight(2e5, 0.0, 0.0, (587.5618,))
    seen = photographed(
        model.rays.chart, camera, light, corners, side, PITCH, torch.Generator().manual_seed(1)
    )
    share = seen.counts / seen.counts.sum((-2, -1), keepdim=True)
    x = (share.sum(-2) * seen.x).sum(-1)
    y = (share.sum(-1) * seen.y).sum(-1)
    # A centroid's standard error is its width over √photons; of 24, the largest is 3 at most.
    off = (torch.stack([x, y], -1) - centres) / (widths[..., None] / 2e5**0.5)
    assert float(off.abs().max()) < 5.0
    square = (share.sum(-2) * (seen.x - x[..., None]) ** 2).sum(-1)
    square = square + (share.sum(-1) * (seen.y - y[..., None]) ** 2).sum(-1)
    assert torch.allclose((0.5 * square).sqrt(), widths, rtol=1e-2)


def photographed_camera(model, prior, seed, photons=3e4):
    """Return drawn numbers and what a camera with them photographs."""
    generator = torch.Generator().manual_seed(seed)
    numbers = prior.mean + prior.deviation * torch.randn(
        len(prior.mean), generator=generator, dtype=torch.float64
    )
    at = dict(zip(model.names, numbers.tolist(), strict=True))
    lens = copy.deepcopy(model.rays.lens)
    for name in model.of_lens:
        lens.variables([name])[name].fill_(at[name])
    camera = TrueCamera(
        lens,
        tuple(at[f"sensor.{part}"] for part in ("x", "y", "tilt_x", "tilt_y")),
        tuple(at[f"chart.{part}"] for part in ("x", "y", "z", "tilt_x", "tilt_y", "tilt_z")),
        at["mark_size"],
        max(at["blur"], 0.0),
        tuple(p + at[f"planes.{n}"] for n, p in enumerate(model.planes, 1)),
    )
    centres, _ = model.spots(prior.mean, model.landed(prior.mean))
    side = 221
    corners = torch.round(centres / PITCH) * PITCH - (side // 2) * PITCH
    light = ChartLight(photons, 2.0, 2.0, (587.5618,))
    return numbers, photographed(model.rays.chart, camera, light, corners, side, PITCH, generator)


def small_prior(model) -> Prior:
    deviation = {
        "elements.middle.decenter_x": 0.02,
        "elements.rear.tilt_y": 0.07 * DEG,
        "thicknesses.2": 0.02,
        "sensor_distance": 0.04,
        **dict.fromkeys(("sensor.x", "sensor.y"), 0.02),
        **dict.fromkeys(("sensor.tilt_x", "sensor.tilt_y"), 0.1 * DEG),
        **dict.fromkeys(("chart.x", "chart.y", "chart.z"), 0.5),
        **dict.fromkeys(("chart.tilt_x", "chart.tilt_y", "chart.tilt_z"), 0.1 * DEG),
        "mark_size": 0.02,
        "blur": 1e-6,
    }
    mean = model.designed
    mean[model.names.index("blur")] = 2.25e-6
    sizes = torch.tensor([deviation.get(n, 0.005) for n in model.names], dtype=torch.float64)
    return Prior(model.names, mean, sizes)


def test_a_camera_is_found_to_its_standard_errors():
    """Errors of two cameras have eᵀC⁻¹e of χ² with their number of degrees of freedom."""
    model = small_model(5, 14)
    prior = small_prior(model)
    coarse = replace(model, rays=replace(model.rays, rings=4, arms=12))
    of_errors, of_sums, freedom = 0.0, 0.0, 0.0
    for seed in range(2):
        numbers, seen = photographed_camera(model, prior, seed)
        fit = fit_chart([coarse, model], seen, prior)
        assert fit.converged
        error = (fit.numbers - numbers) / prior.deviation
        of_errors += float(error @ torch.linalg.solve(fit.scaled_covariance, error))
        of_sums, freedom = of_sums + fit.chi_squared, freedom + fit.degrees_of_freedom
    count = 2 * len(model.names)
    assert abs(of_errors - count) < 4.0 * (2.0 * count) ** 0.5
    assert abs(of_sums - freedom) < 4.0 * (2.0 * freedom) ** 0.5
    # What 6 marks tell: the lens's numbers to a part of their tolerances.
    assert float((fit.standard_errors / prior.deviation)[:2].max()) < 0.5


def test_photographs_do_not_tell_a_camera_from_a_chart_that_is_shifted():
    """All elements and the sensor by as much as the chart: no image changes, and no error does."""
    names = tuple(f"elements.{e}.decenter_x" for e in ("front", "middle", "rear"))
    model = small_model(8, 24, planes=(2.6,), names=(*names, "sensor_distance"))
    prior = replace(small_prior(model), deviation=torch.full_like(model.designed, 0.01))
    prior.deviation[model.names.index("blur")] = 1e-6
    _, seen = photographed_camera(model, prior, 5)
    coarse = replace(model, rays=replace(model.rays, rings=5, arms=16))
    fit = fit_chart([coarse, model], seen, prior)
    shift = torch.zeros_like(prior.mean)
    for name in (*names, "sensor.x", "chart.x"):
        shift[model.names.index(name)] = 5**-0.5
    assert float(shift @ fit.scaled_covariance @ shift) == pytest.approx(1.0, abs=0.01)
    # A sensor that stands farther away is no other than a plane that does.
    shift = torch.zeros_like(prior.mean)
    shift[model.names.index("sensor_distance")] = 2**-0.5
    shift[model.names.index("planes.1")] = -(2**-0.5)
    assert float(shift @ fit.scaled_covariance @ shift) == pytest.approx(1.0, abs=1e-6)
    deviations, _ = fit.combinations()
    assert float(deviations[0]) <= 1.0 + 1e-9


def test_a_window_without_a_mark_is_named():
    model = small_model(4, 12)
    prior = small_prior(model)
    _, seen = photographed_camera(model, prior, 1, photons=2e4)
    seen.counts[1, 3] = 0.0
    with pytest.raises(InputError, match="photograph 2 shows no mark 4"):
        fit_chart([model], seen, prior)
