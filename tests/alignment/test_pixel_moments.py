"""Pixels and moments of spots: Sheppard's corrections, read noise, windows, the grid's place."""

import math

import pytest
import torch

from dolens import InputError
from dolens.alignment.element_fit import moment_covariance
from dolens.alignment.moments import (
    POWERS,
    Pixels,
    check_window,
    convolved,
    grid_error,
    observed_radius,
    read_covariance,
    shift_derivatives,
    weighted_sums,
)

# A spot like a comet: light from two round clouds (mm), share, centre and deviation of each.
CLOUDS = ((0.7, (0.0008, -0.0021), 0.0050), (0.3, (-0.0012, 0.0095), 0.0070))
PITCH = 0.00345


def nodes(count=12):
    """Points (2, N) and shares (N, 1) whose moments are the clouds', by Gauss and Hermite."""
    # Golub and Welsch: nodes are eigenvalues of the matrix of the recurrence.
    beside = torch.arange(1, count, dtype=torch.float64).sqrt()
    at, vectors = torch.linalg.eigh(torch.diag(beside, 1) + torch.diag(beside, -1))
    weight = vectors[0].square()
    grid = torch.cartesian_prod(at, at).T
    shares = torch.outer(weight, weight).flatten()
    points = [
        torch.tensor(centre, dtype=torch.float64)[:, None] + width * grid
        for _, centre, width in CLOUDS
    ]
    return torch.cat(points, 1), torch.cat([part * shares for part, *_ in CLOUDS])[:, None]


def spot():
    """Of the clouds: points, shares, centroid (1, 2), and RMS radius (1,)."""
    points, shares = nodes()
    origin = (points @ shares).T
    size = ((points - origin.T).square().sum(0) @ shares).sqrt()
    return points, shares, origin, size


def test_rounding_to_pixels_adds_what_sheppard_says():
    points, shares, origin, size = spot()
    origin = origin + 0.002
    sums = weighted_sums(points, shares, origin, size, POWERS)
    found = dict(zip(POWERS, convolved(sums, POWERS, PITCH / size)[0].tolist(), strict=True))
    own = dict(zip(POWERS, sums[0].tolist(), strict=True))
    twelfth = float(PITCH / size) ** 2 / 12.0
    assert found[1, 0] == own[1, 0] and found[1, 1] == own[1, 1]
    assert found[2, 0] == pytest.approx(own[2, 0] + twelfth, rel=1e-12)
    assert found[0, 3] == pytest.approx(own[0, 3] + 3.0 * twelfth * own[0, 1], rel=1e-12)
    assert found[2, 1] == pytest.approx(own[2, 1] + twelfth * own[0, 1], rel=1e-12)


def test_the_covariance_is_that_of_a_spot_spread_over_pixels():
    points, shares, origin, size = spot()
    found = moment_covariance(points, shares, origin, size, 100.0, PITCH)
    # Four Gauss points across a pixel have its moments up to the seventh.
    at = torch.tensor([math.sqrt(3 / 7 + s * 2 / 7 * math.sqrt(1.2)) for s in (-1, 1)])
    at = torch.cat([-at, at]).double()
    weight = torch.tensor([(18 + s * math.sqrt(30)) / 72 for s in (1, -1, 1, -1)]).double()
    within = 0.5 * PITCH * torch.cartesian_prod(at, at).T
    spread = (points[:, :, None] + within[:, None]).flatten(1)
    share = (shares * torch.outer(weight, weight).flatten()).flatten()[:, None]
    expected = moment_covariance(spread, share, origin, size, 100.0)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_mean_and_covariance_against_photons_counted_one_by_one():
    # One exposure: clouds so smooth that the grid's place does not matter.
    points, shares, origin, size = spot()
    photons, trials, noise, window = 2000, 8000, 0.12, 5.0
    sums = weighted_sums(points, shares, origin, size, POWERS)
    mean = convolved(sums, POWERS, PITCH / size)
    from_photons = moment_covariance(points, shares, origin, size, photons, PITCH)[0]
    pixels = Pixels(PITCH, noise, window)
    from_reading = read_covariance(pixels, origin, mean, size, photons)[0]
    covariance = from_photons + from_reading
    # Either is a good part of the noise somewhere, or this would not test it.
    part = from_reading.diagonal() / covariance.diagonal()
    assert float(part.min()) < 0.5 < float(part.max())

    generator = torch.Generator().manual_seed(5)
    half = math.ceil(window * math.hypot(float(size), PITCH / math.sqrt(6.0)) / PITCH)
    middle = [round(float(c) / PITCH) for c in origin[0]]
    step = torch.arange(-half, half + 1)
    x, y = ((m + step) * PITCH - c for m, c in zip(middle, origin[0], strict=True))
    x, y = torch.meshgrid(x / size, y / size, indexing="ij")
    values = torch.stack([x**i * y**j for i, j in POWERS]).flatten(1)
    centres = torch.tensor([centre for _, centre, _ in CLOUDS])
    widths = torch.tensor([width for *_, width in CLOUDS])
    measured = []
    for _ in range(8):
        many = (trials // 8, photons)
        cloud = (torch.rand(many, generator=generator) < CLOUDS[1][0]).long()
        where, inside = 0, True
        for axis in (0, 1):
            drawn = torch.randn(many, generator=generator) * widths[cloud]
            pixel = torch.floor((drawn + centres[cloud, axis]) / PITCH + 0.5).long()
            pixel = pixel - middle[axis] + half
            inside = inside & (pixel >= 0) & (pixel < len(step))
            where = where * len(step) + pixel
        # A few in a million are beside the window.
        assert float(inside.double().mean()) > 0.99999
        counts = torch.zeros(many[0], len(step) ** 2, dtype=torch.float64)
        counts.scatter_add_(1, where.clamp(0, counts.shape[1] - 1), inside.double())
        counts += noise * torch.randn(counts.shape, generator=generator, dtype=torch.float64)
        measured.append(counts @ values.T / counts.sum(1, keepdim=True))
    measured = torch.cat(measured)
    deviation = covariance.diagonal().sqrt()
    apart = (measured.mean(0) - mean[0]) / deviation
    # Means of 8000 scatter by 1.1 % of a deviation, and the covariance's entries by 1.6 %.
    assert float(apart.abs().max()) < 0.06
    difference = (torch.cov(measured.T) - covariance) / torch.outer(deviation, deviation)
    assert float(difference.abs().max()) < 0.07


def test_read_noise_of_the_smallest_window_by_hand():
    # Of a spot that is tiny beside a pixel: 7 × 7 pixels about the pixel that it is in.
    size, pixels = torch.ones(1, dtype=torch.float64), Pixels(1.0, read_noise=3.0, window=1.0)
    origin = torch.tensor([[0.2, -5.3]], dtype=torch.float64)
    mean = torch.zeros(1, 9, dtype=torch.float64)
    mean[0, 2] = mean[0, 4] = 0.1
    found = read_covariance(pixels, origin, mean, size, 1e3)[0]
    x = [k - 0.2 for k in range(-3, 4)]
    y = [-5 + k + 5.3 for k in range(-3, 4)]
    factor = 9.0 / 1e6
    assert float(found[0, 0]) == pytest.approx(factor * sum(7 * a * a for a in x), rel=1e-12)
    squares = sum(7 * (a * a - 0.1) ** 2 for a in x)
    assert float(found[2, 2]) == pytest.approx(factor * squares, rel=1e-12)
    mixed = sum(a * (a * b * b) for a in x for b in y)
    assert float(found[0, 7]) == pytest.approx(factor * mixed, rel=1e-12)


def test_the_sensors_place_in_the_moments_against_differences():
    points, shares, origin, size = spot()

    def moved(x, y):
        shift = torch.tensor([[x], [y]], dtype=torch.float64)
        return weighted_sums(points - shift, shares, origin, size, POWERS)

    found = shift_derivatives(moved(0.0, 0.0), size)
    for axis, step in enumerate(((1e-6, 0.0), (0.0, 1e-6))):
        slope = (moved(*step) - moved(-step[0], -step[1])) / 2e-6
        torch.testing.assert_close(found[..., axis], slope, rtol=1e-6, atol=1e-4)


def test_what_depends_on_the_grids_place():
    # A spot without extent, 0.3 pixels to the right of a pixel's centre, and on its centre in y.
    point = torch.tensor([[0.3], [2.0]]).double()
    one, origin = torch.ones(1, 1).double(), torch.zeros(1, 2).double()
    places = torch.tensor([[0.0, 0.0], [0.1, 0.0]])
    found = grid_error(point, one, origin, torch.ones(1).double(), 1.0, places)
    # Counted at 0, and at 0.1: that less what rounding does on the mean, (0.3, 0.3² + 1/12).
    torch.testing.assert_close(found[:, 0, 0], torch.tensor([-0.3, -0.2]).double())
    squares = torch.tensor([0.0, 0.01]).double() - 0.09 - 1.0 / 12.0
    torch.testing.assert_close(found[:, 0, 2], squares)
    # Averaged over places it vanishes.
    lattice = (torch.arange(1000) + 0.5).double() / 1000
    lattice = torch.stack([lattice, torch.zeros_like(lattice)], 1)
    mean = grid_error(point, one, origin, torch.ones(1).double(), 1.0, lattice).mean(0)[0]
    assert float(mean[[0, 2, 5]].abs().max()) < 1e-5


def test_bad_input_gives_one_clear_line():
    with pytest.raises(InputError, match=r"pixel_pitch: -0\.1; allowed: a positive"):
        Pixels(-0.1)
    with pytest.raises(InputError, match="read_noise: -1; allowed: 0 or more"):
        Pixels(0.1, -1)
    with pytest.raises(InputError, match="window: nan; allowed: a positive number"):
        Pixels(0.1, 1.0, math.nan)
    points, shares, origin, size = spot()
    mean = weighted_sums(points, shares, origin, size, POWERS)
    radius = observed_radius(mean, size)
    torch.testing.assert_close(radius, size)
    check_window(Pixels(PITCH, window=7.0), points, shares, origin, radius)
    with pytest.raises(InputError, match=r"window: 2; light lands up to .* RMS radii"):
        check_window(Pixels(PITCH, window=2.0), points, shares, origin, radius)
