"""The region of existing glasses: it holds all of them, and its walls have the slopes they say."""

import pytest
import torch

from dolens import InputError
from dolens.lens_search.glass.dispersion_coordinates import glass_region, nearest, pull, spread

SQUARE = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0], [1.0, 0.5]]).double()


def cloud(count=200, dimension=3):
    return torch.randn(count, dimension, generator=torch.Generator().manual_seed(2)).double()


def test_a_rectangle_has_four_walls():
    region = glass_region(SQUARE)
    assert len(region.bounds) == 4
    torch.testing.assert_close(region.normals.norm(dim=1), torch.ones(4).double())
    inside = torch.tensor([[1.9, 0.1], [2.1, 0.5], [1.0, -0.25]]).double()
    assert region.contains(inside).tolist() == [True, False, False]
    # How far outside: along the walls' normals.
    torch.testing.assert_close(
        region.excess(inside).amax(1)[1:], torch.tensor([0.1, 0.25]).double()
    )


def test_all_glasses_are_inside_and_their_doubles_are_not():
    points = cloud()
    region = glass_region(points)
    assert region.contains(points).all()
    assert region.contains(points.mean(0))
    assert not region.contains(points[points.norm(dim=1) > 2.5] * 3.0).any()
    # A mixture of glasses is inside, too.
    weights = torch.rand(50, len(points), generator=torch.Generator().manual_seed(3)).double()
    assert region.contains(weights / weights.sum(1, keepdim=True) @ points).all()


@pytest.mark.parametrize("name", ["hinges", "penalty"])
def test_penalties_and_their_derivatives(name):
    region = glass_region(cloud(dimension=2))
    x = torch.tensor([[4.0, 3.0], [-0.5, 5.0], [0.1, 0.2]]).double()
    value, slopes = getattr(region, name)(x, 0.1)
    for row, one, slope in zip(x, value, slopes, strict=True):
        exact = torch.autograd.functional.jacobian(lambda x: getattr(region, name)(x, 0.1)[0], row)
        torch.testing.assert_close(slope, exact, rtol=1e-12, atol=1e-14)
        assert bool((one > 0.0).any()) is not bool(region.contains(row))


def test_both_penalties_have_one_square():
    region = glass_region(cloud())
    x = 4.0 * cloud(20)
    hinges, _ = region.hinges(x)
    torch.testing.assert_close(hinges.square().sum(-1), region.penalty(x)[0].square())


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_glasses_have_a_region_of_no_thickness(count):
    points = cloud(count)
    region = glass_region(points)
    assert region.contains(points).all()
    assert region.contains(points.mean(0))
    away = points.mean(0) + torch.linalg.svd(points - points.mean(0))[2][-1]
    assert region.excess(away).max() == pytest.approx(1.0, abs=1e-9)


def test_the_nearest_glasses():
    points = cloud()
    distances, numbers = nearest(points, points, 3)
    assert torch.equal(numbers[:, 0], torch.arange(len(points)))
    assert (distances[:, 0] == 0.0).all()
    assert (distances.diff(dim=1) >= 0.0).all()
    vector, number = pull(points[5] + 1e-3, points)
    assert int(number) == 5
    torch.testing.assert_close(
        vector, torch.full((3,), 1e-3, dtype=torch.float64), atol=1e-15, rtol=0.0
    )
    # Where only the first coordinate counts, another glass may be the nearest.
    weights = torch.tensor([1.0, 0.0, 0.0]).double()
    closest = (points[:, 0] - 0.3).abs().argmin()
    asked = torch.tensor([0.3, 9.0, 9.0]).double()
    assert int(nearest(asked, points, 1, weights)[1]) == int(closest)


def test_glasses_far_from_each_other_are_spread_over_the_set():
    points = cloud()
    chosen = spread(points, 20)
    assert len(chosen.unique()) == 20
    away = torch.cdist(points[chosen], points[chosen]) + 9.0 * torch.eye(20).double()
    covered = torch.cdist(points, points[chosen]).amin(1).max()
    assert away.min() >= covered


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.tensor([[0.0, float("nan")]])])
def test_no_region_of_nothing(points):
    with pytest.raises(InputError, match="region"):
        glass_region(points.double())
