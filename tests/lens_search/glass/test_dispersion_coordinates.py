"""Coordinates of glass: what they give is the model glass, real glass is near, and has a region."""

import pytest
import torch

from dolens import InputError
from dolens.lens_search.glass.dispersion_coordinates import (
    CENTRE,
    UNIT,
    conrady_basis,
    fitted_basis,
    glass_coordinates,
    glass_region,
    material_text,
    medium_indices,
    nd_vd_deviation,
    nearest,
    spread,
)
from dolens.optics.glass_catalog import MAKERS, find_glass, table, table_glass
from dolens.optics.materials import index_model, parse_material

VISIBLE = (435.8343, 460.0, 486.1327, 520.0, 546.074, 587.5618, 620.0, 656.2725)


def makers_glasses():
    glasses = []
    for maker in MAKERS[:-1]:
        for key in table(maker):
            glass = table_glass(maker, key)
            first, last = glass.wavelengths
            if first <= 400.0 and last >= 700.0:
                glasses.append(glass)
    return glasses


@pytest.fixture(scope="module")
def glasses():
    return makers_glasses()


@pytest.mark.parametrize("glass", [(1.5168, 64.17, -0.0009), (1.80518, 25.36, 0.0092)])
def test_conrady_s_basis_is_the_model_glass_of_a_prescription(glass):
    text = "/".join(map(str, glass))
    medium = parse_material(text, index_model("dfc"))
    nd, vd, deviation = glass
    fall = (nd - 1.0) / vd
    x = torch.tensor([nd, fall, fall * deviation], dtype=torch.float64)
    x = (x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(UNIT, dtype=x.dtype)
    index = conrady_basis(VISIBLE).index(x)
    torch.testing.assert_close(index, medium_indices([medium], VISIBLE)[0], rtol=1e-14, atol=0.0)
    assert nd_vd_deviation(x) == pytest.approx(glass, rel=1e-12)
    again = parse_material(material_text(x), index_model("dfc"))
    assert again.index(460.0) == pytest.approx(medium.index(460.0), rel=1e-12)


def test_coordinates_of_a_catalogue_glass_are_those_of_its_three_numbers():
    x = glass_coordinates(find_glass("SCHOTT:N-BK7"))
    assert nd_vd_deviation(x) == pytest.approx((1.5168, 64.17, -0.0009), rel=1e-4, abs=1e-4)


def test_the_derivative_is_that_of_the_index():
    basis = conrady_basis(VISIBLE)
    x = torch.tensor([[0.3, -0.4, 0.7], [1.0, 2.0, -0.5]], dtype=torch.float64)
    for row in x:
        exact = torch.autograd.functional.jacobian(basis.index, row)
        torch.testing.assert_close(basis.slopes, exact.T, rtol=1e-14, atol=1e-16)


def test_real_glass_is_near_in_the_visible(glasses):
    assert len(glasses) > 2000
    x = torch.tensor([glass_coordinates(g) for g in glasses], dtype=torch.float64)
    indices = medium_indices(glasses, VISIBLE)
    conrady = (conrady_basis(VISIBLE).index(x) - indices).abs()
    fitted = (fitted_basis(VISIBLE, glasses).index(x) - indices).abs()
    assert fitted.max() < 1e-4
    assert fitted.square().mean().sqrt() < 1e-5
    assert conrady.square().mean().sqrt() < 6e-5
    assert (conrady.amax(1) > 1e-4).double().mean() < 0.1
    # nd is given exactly.
    assert fitted[:, VISIBLE.index(587.5618)].max() < 1e-14


def test_a_step_of_one_is_as_common_in_each_coordinate(glasses):
    x = torch.tensor([glass_coordinates(g) for g in glasses], dtype=torch.float64)
    assert ((x.std(0) > 0.8) & (x.std(0) < 1.6)).all()


def test_two_coordinates_leave_out_the_deviation_alone():
    glasses = [find_glass(name) for name in ("N-BK7", "SCHOTT:F2", "N-SF6", "N-LAK33B", "N-FK51A")]
    basis = fitted_basis((486.1327, 587.5618, 656.2725), glasses, count=2)
    assert basis.slopes.shape == (2, 3)
    x = torch.tensor([glass_coordinates(g)[:2] for g in glasses], dtype=torch.float64)
    error = basis.index(x) - medium_indices(glasses, basis.wavelengths)
    assert error.abs().max() < 1e-4


def test_one_glass_is_met_exactly_by_the_basis_fitted_to_it():
    glass = find_glass("N-KZFS4")
    basis = fitted_basis((400.0, 700.0, 1000.0), [glass])
    x = torch.tensor(glass_coordinates(glass), dtype=torch.float64)
    expected = medium_indices([glass], basis.wavelengths)[0]
    torch.testing.assert_close(basis.index(x), expected, rtol=1e-13, atol=0.0)


def test_a_plastic_whose_range_begins_above_the_g_line_has_coordinates():
    glass = find_glass("PLASTIC:POLYCARBONATE")
    assert glass.wavelengths[0] > 435.9
    x = torch.tensor(glass_coordinates(glass), dtype=torch.float64)
    lines = (436.8, 486.1327, 587.5618, 656.2725)
    index = conrady_basis(lines).index(x)
    exact = medium_indices([glass], lines)[0]
    # Conrady's formula meets nd, nF - nC and the rise from F to the first wavelength.
    for error in (index[2] - exact[2], *(index - exact)[[1]] - (index - exact)[[3]],
                  (index - exact)[0] - (index - exact)[1]):  # fmt: skip
        assert abs(error) < 1e-13


@pytest.mark.parametrize(
    ("ask", "word"),
    [
        (lambda: conrady_basis((0.0,)), "positive"),
        (lambda: conrady_basis((500.0,), count=4), "2 or 3"),
        (lambda: glass_coordinates(parse_material("1.5", index_model("dfc"))), "does not fall"),
        (lambda: glass_coordinates(find_glass("INFRARED:GERMANIUM")), "range"),
    ],
)
def test_what_is_wrong_is_said(ask, word):
    with pytest.raises(InputError, match=word):
        ask()


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


def test_hinges_and_their_derivatives():
    region = glass_region(cloud(dimension=2))
    x = torch.tensor([[4.0, 3.0], [-0.5, 5.0], [0.1, 0.2]]).double()
    for row, one, slope in zip(x, *region.hinges(x), strict=True):
        exact = torch.autograd.functional.jacobian(lambda x: region.hinges(x)[0], row)
        torch.testing.assert_close(slope, exact, rtol=1e-12, atol=1e-14)
        assert bool((one > 0.0).any()) is not bool(region.contains(row))


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
