"""Many lenses of one structure are traced and differentiated as each alone, and by parts."""

import copy

import pytest
import torch
from torch.func import vmap

import dolens
from dolens import Rays
from dolens.kernels.table import MapOfLenses
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.lens_family import (
    FamilyRays,
    LensFamily,
    intercept_parts,
    jacobian_parts,
    shared_rays,
)
from dolens.optics.ray_tracing import trace_rays
from dolens.tolerancing.tolerances import with_glass_elements

WAVELENGTHS = (656.2725, 587.5618, 486.1327)
NAMES = ["surfaces.*.curvature", "thicknesses.*", "sensor_distance"]
POSES = ["elements.*.tilt_[xy]", "elements.*.decenter_[xy]", "surfaces.2.curvature"]
LENSES, RAYS = 5, 200
shapes_and_poses = pytest.mark.parametrize(
    "family", [NAMES, POSES], indirect=True, ids=["shapes", "poses"]
)


@pytest.fixture(scope="module")
def family(request):
    lens = with_glass_elements(dolens.load_lens("cooke_triplet", dtype=torch.float64))
    return LensFamily(lens, getattr(request, "param", NAMES), WAVELENGTHS)


@pytest.fixture(scope="module")
def values(family):
    generator = torch.Generator().manual_seed(1)
    off = torch.randn(LENSES, family.count, generator=generator, dtype=torch.float64)
    return family.start * (1.0 + 0.01 * off) + 1e-3 * (family.start == 0.0) * off


@pytest.fixture(scope="module")
def rays():
    """Some of them miss or are clipped: the beam is wider than the lens."""
    generator = torch.Generator().manual_seed(2)
    position = 5.0 * torch.randn(LENSES, RAYS, 3, generator=generator, dtype=torch.float64)
    position[..., 2] = -10.0
    direction = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(LENSES, RAYS, 3)
    return FamilyRays(position, direction, (torch.arange(RAYS) % 3).int())


def one_lens(family, values, row):
    lens = copy.deepcopy(family.lens)
    parameters = lens.variables(list(family.columns))
    with torch.no_grad():
        for name, where in family.columns.items():
            parameters[name].copy_(values[row, where].reshape(parameters[name].shape))
    return lens


def rays_of(rays, row):
    waves = torch.tensor(WAVELENGTHS, dtype=torch.float64)[rays.wavelength.long()]
    return Rays(rays.position[row], rays.direction[row], waves)


@shapes_and_poses
@pytest.mark.parametrize("row", range(LENSES))
def test_every_lens_is_traced_as_it_would_be_alone(family, values, rays, row):
    together = family.trace(values, rays)
    alone = one_lens(family, values, row).trace(rays_of(rays, row))
    assert torch.equal(together.status[row], alone.status)
    assert torch.equal(together.surface[row], alone.surface)
    assert 0 < int(alone.valid.sum()) < RAYS
    valid = alone.valid
    torch.testing.assert_close(
        together.position[row][valid], alone.position[valid], rtol=0.0, atol=1e-12
    )
    torch.testing.assert_close(
        together.path_length[row][valid], alone.path_length[valid], rtol=0.0, atol=1e-11
    )


@shapes_and_poses
def test_a_batch_is_what_vmap_over_the_reference_gives(family, values, rays):
    lens = family.lens.double()
    which = rays.wavelength == 1
    few = Rays(rays.position[0][which], rays.direction[0][which], WAVELENGTHS[1])

    def sensor_points(row):
        parts = {
            name: row[where].reshape(lens.variables([name])[name].shape)
            for name, where in family.columns.items()
        }
        traced = trace_rays(lens.system(parts).traced_by("reference"), few)
        return traced.position, traced.valid

    points, valid = vmap(sensor_points)(values)
    shared = FamilyRays(
        few.position.expand(LENSES, -1, 3),
        few.direction.expand(LENSES, -1, 3),
        torch.ones(int(which.sum()), dtype=torch.int32),
    )
    found = family.trace(values, shared)
    assert torch.equal(found.valid, valid)
    torch.testing.assert_close(found.position[valid], points[valid], rtol=0.0, atol=1e-11)


@shapes_and_poses
def test_jacobians_and_normal_equations_are_those_of_each_lens(family, values, rays):
    jacobians = family.jacobians(values, rays)
    group = torch.arange(RAYS) // 50
    target = torch.tensor([0.1, 4.0], dtype=torch.float64).expand(LENSES, RAYS, 2)
    weight = torch.linspace(0.5, 1.5, RAYS, dtype=torch.float64).expand(LENSES, RAYS)
    sums = family.normal_equations(values, rays, target, weight, group, 4)
    for row in range(LENSES):
        lens = one_lens(family, values, row)
        names = list(family.columns)
        alone = ray_jacobian(lens, rays_of(rays, row), names)
        order = torch.cat(
            [torch.arange(p.start, p.stop) for p in (alone.columns[n] for n in family.columns)]
        )
        torch.testing.assert_close(
            jacobians.derivatives[row], alone.derivatives.permute(1, 2, 0)[:, order],
            rtol=1e-10, atol=1e-10,
        )  # fmt: skip
        equations = normal_equations(
            lens, rays_of(rays, row), names, target[row], weight[row], group
        )
        jtj = equations.jtj[order][:, order]
        torch.testing.assert_close(sums.jtj[row], jtj, rtol=1e-10, atol=1e-9)
        torch.testing.assert_close(sums.jtr[row], equations.jtr[order], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(sums.group_residual[row], equations.groups.residual)
        assert float(sums.count[row]) == float(equations.count)


@shapes_and_poses
def test_the_gradient_of_a_trace_is_the_sum_of_its_jacobian(family, values, rays):
    leaf = values.clone().requires_grad_()
    traced = family.trace(leaf, rays)
    (gradient,) = torch.autograd.grad(traced.position[..., 1].sum(), leaf)
    jacobians = family.jacobians(values, rays)
    torch.testing.assert_close(gradient, jacobians.derivatives[:, 1].sum(-1), rtol=1e-9, atol=1e-9)


def test_indices_are_variables(family, values, rays):
    """Differences of the index of the flint at each wavelength, in float64."""
    base = family.table(values).indices.clone()
    rows, columns = torch.tensor([3]), torch.tensor([family.count])
    slope = torch.tensor([[0.7, 1.0, 1.6]], dtype=torch.float64).expand(LENSES, 1, 3)
    found = family.jacobians(
        values,
        rays,
        indices=base,
        variables=MapOfLenses(
            family.with_indices(rows, columns, family.count + 1),
            index_derivatives=slope.contiguous(),
        ),
    )
    step = 1e-6
    ends = []
    for side in (step, -step):
        moved = base.clone()
        moved[:, 3] += side * slope[:, 0]
        ends.append(family.trace(values, rays, moved))
    valid = found.valid & ends[0].valid & ends[1].valid
    difference = (ends[0].position - ends[1].position)[..., :2] / (2.0 * step)
    torch.testing.assert_close(
        found.derivatives[:, :, -1].mT[valid], difference[valid], rtol=1e-6, atol=1e-6
    )
    torch.testing.assert_close(
        found.derivatives[:, :, :-1], family.jacobians(values, rays).derivatives
    )


def test_points_on_a_surface_are_those_of_a_recorded_trace(family, values, rays):
    lens = one_lens(family, values, 0)
    path = lens.trace(rays_of(rays, 0), record=True).points
    points, arrives = family.intercepts(values, rays, 4)
    torch.testing.assert_close(
        points[0][arrives[0]], path[3][arrives[0]][..., :2], rtol=0.0, atol=1e-11
    )


def test_columns_come_in_the_order_that_is_asked_for():
    lens = dolens.load_lens("cooke_triplet", dtype=torch.float64)
    family = LensFamily(lens, ["sensor_distance", "surfaces.3.curvature"], [587.6])
    assert list(family.columns) == ["sensor_distance", "surfaces.3.curvature"]
    expected = [lens.sensor_distance.item(), lens.surfaces["3"].curvature.item()]
    assert family.start.tolist() == expected


def test_single_precision_agrees_and_its_overflows_are_computed_in_double():
    lens = dolens.load_lens("cooke_triplet", dtype=torch.float32)
    family = LensFamily(lens, NAMES, [587.5618])
    start = family.start.expand(2, -1)
    position = torch.tensor([[0.0, 1.0, -1.0]]).expand(2, 1, 3)
    direction = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 1, 3)
    # Residuals of 1e25 have squares beyond float32.
    target = torch.tensor([[[0.0, 0.0]], [[0.0, 1e25]]])
    sums = family.normal_equations(start, FamilyRays(position, direction), target)
    assert float(sums.sum_of_squares[1]) == pytest.approx(1e50, rel=1e-5)
    double = LensFamily(lens.double(), NAMES, [587.5618])
    exact = double.normal_equations(
        start.double(), FamilyRays(position.double(), direction.double()), target.double()
    )
    torch.testing.assert_close(sums.jtj[0], exact.jtj[0], rtol=1e-4, atol=1e-4)


def test_indices_vary_beside_poses():
    """In single precision, where rounding decides which derivatives of the records are zero."""
    found = []
    for dtype in (torch.float32, torch.float64):
        lens = with_glass_elements(dolens.load_lens("cooke_triplet", dtype=dtype))
        family = LensFamily(lens, POSES, [587.5618])
        generator = torch.Generator().manual_seed(5)
        off = torch.randn(2, family.count, generator=generator, dtype=torch.float64)
        position = torch.randn(2, 20, 3, generator=generator, dtype=torch.float64)
        position[..., 2] = -5.0
        direction = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(2, 20, 3)
        jacobians = family.jacobians(
            (family.start + 1e-2 * off).to(dtype),
            FamilyRays(position.to(dtype), direction),
            variables=MapOfLenses(
                family.with_indices(
                    torch.tensor([1]), torch.tensor([family.count]), family.count + 1
                ),
                index_derivatives=torch.ones((2, 1, 1), dtype=torch.float64),
            ),
        )
        found.append(jacobians.derivatives.double())
    scale = found[1].abs().amax((0, 3), keepdim=True)
    assert float(scale.min()) > 0.0
    torch.testing.assert_close(found[0] / scale, found[1] / scale, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("size", [1, 3, LENSES, 100])
@shapes_and_poses
def test_parts_are_what_the_whole_is(family, values, rays, size):
    wavelengths, shared = shared_rays(rays_of(rays, 0))
    assert wavelengths == tuple(sorted(WAVELENGTHS))
    family = LensFamily(family.lens, list(family.columns), wavelengths)
    traced = family.trace(values, shared.of_each(LENSES))
    expected = family.jacobians(values, shared.of_each(LENSES))
    seen = []
    for rows, points, arrives in intercept_parts(family, values, shared, size):
        assert torch.equal(points, traced.position[rows, :, :2])
        assert torch.equal(arrives, traced.status[rows] <= 1)
        seen += range(LENSES)[rows]
    assert seen == list(range(LENSES)) and 0 < int(traced.valid.sum()) < LENSES * RAYS
    for rows, found in jacobian_parts(family, values, shared, size):
        assert torch.equal(found.valid, expected.valid[rows])
        torch.testing.assert_close(found.values, expected.values[rows], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(
            found.derivatives, expected.derivatives[rows], rtol=1e-12, atol=1e-10
        )


def test_a_family_of_no_lens_has_no_parts(family, values, rays):
    _, shared = shared_rays(rays_of(rays, 0))
    assert not list(intercept_parts(family, values[:0], shared, 3))
