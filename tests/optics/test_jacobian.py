"""Jacobians of every ray and their sums for least squares, on the kernels and on the reference."""

import pytest
import torch

from dolens import InputError, Rays, load_lens
from dolens.optics.jacobian import normal_equations, ray_jacobian
from tests.kernels.trace_cases import LENSES

ALL = ("x", "y", "path_length")
EVERY = ["surfaces.*", "thicknesses.*", "sensor_distance"]


def wide_bundle(lens, count=300, dtype=torch.float64, wavelengths=(486.1, 587.6, 656.3)):
    """Rays of three wavelengths over more than the lens lets through, skew to its axis."""
    radius = 1.15 * lens.surfaces["1"].semi_diameter
    generator = torch.Generator().manual_seed(3)
    start = 2.0 * torch.rand((count, 3), generator=generator, dtype=torch.float64) - 1.0
    position = start * torch.tensor([radius, radius, 0.0]).double() + torch.tensor([0, 0, -3.0])
    direction = torch.tensor([0.03, -0.05, 1.0]).double().expand(count, 3)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    wavelength = torch.tensor(wavelengths).double()[torch.arange(count) % len(wavelengths)]
    return Rays(position.to(dtype), direction.to(dtype), wavelength)


@pytest.fixture(params=["auto", "reference"])
def backend(request):
    return request.param


def test_invalid_rays_have_zeros_and_touch_no_other(root, backend):
    lens = load_lens(root / "conf/lens/asphere.yaml")
    lens.backend = backend
    rays = wide_bundle(lens, count=256)
    clean = ray_jacobian(lens, rays, EVERY, ALL)
    position = rays.position.clone()
    spoiled = torch.arange(256) % 3 == 0
    position[spoiled] = torch.tensor([float("nan"), float("inf"), 0.0]).double()
    found = ray_jacobian(lens, Rays(position, rays.direction, rays.wavelength), EVERY, ALL)
    assert not found.valid[spoiled].any()
    assert torch.equal(found.valid[~spoiled], clean.valid[~spoiled])
    for result in (clean, found):
        assert not result.values[~result.valid].any()
        assert not result.derivatives[~result.valid].any()
    kept = ~spoiled
    assert (found.values - clean.values)[kept].abs().max() < 1e-12
    scale = clean.derivatives.abs().amax(0)
    assert ((found.derivatives - clean.derivatives)[kept].abs().amax(0) <= 1e-12 * scale).all()


def test_columns_that_do_not_matter_are_zero(root, backend):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    lens.backend = backend
    axis = Rays(torch.tensor([[0.0, 0.0, -5.0]]).double(), torch.tensor([0.0, 0.0, 1.0]).double())
    found = ray_jacobian(lens, axis, EVERY, ALL)
    assert found.valid.all()
    assert not found.derivatives[0, :2].any()
    column = found.columns["sensor_distance"].start
    assert float(found.derivatives[0, 2, column]) == pytest.approx(1.0)


@pytest.mark.parametrize("shape", [(0,), (1,), (2, 3), ()])
def test_any_leading_shape(root, backend, shape):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    lens.backend = backend
    position = torch.zeros((*shape, 3), dtype=torch.float64)
    position[..., 1] = 1.0
    found = ray_jacobian(
        lens, Rays(position, torch.tensor([0.0, 0.0, 1.0]).double()), ["surfaces.*.curvature"]
    )
    assert found.values.shape == (*shape, 2)
    assert found.derivatives.shape == (*shape, 2, 6)
    assert found.valid.shape == shape


def test_rays_of_finer_precision_than_the_lens(root, backend):
    """They are moved to the lens first; the path from their start is in the path length."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float32)
    lens.backend = backend
    position = torch.tensor([[0.0, 1.0, -1000.0]]).double()
    rays = Rays(position, torch.tensor([0.0, 0.0, 1.0]).double())
    found = ray_jacobian(lens, rays, ["sensor_distance"], ("path_length",))
    expected = float(lens.trace(rays).path_length.detach())
    assert found.values.dtype == torch.float32
    assert float(found.values) == pytest.approx(expected, rel=1e-6)
    sums = normal_equations(
        lens, rays, ["sensor_distance"], target=expected - 0.5, outputs=("path_length",)
    )
    assert float(sums.sum_of_squares) == pytest.approx(0.25, rel=1e-3)


def test_single_precision_is_close(root):
    name = root / "conf/lens/cooke_triplet.yaml"
    exact, lens = load_lens(name), load_lens(name, dtype=torch.float32)
    rays = wide_bundle(exact, count=2000)
    single = wide_bundle(exact, count=2000, dtype=torch.float32)
    expected, found = ray_jacobian(exact, rays, EVERY), ray_jacobian(lens, single, EVERY)
    assert found.derivatives.dtype == torch.float32
    both = expected.valid & found.valid
    assert int((expected.valid != found.valid).sum()) <= 2
    scale = expected.derivatives.abs().amax(0)
    error = (found.derivatives - expected.derivatives)[both].abs().amax(0)
    assert (error <= 1e-4 * scale).all()


@pytest.fixture(params=["asphere", "posed", "b_spline"])
def any_lens(request, root):
    return LENSES[request.param](root)


def explicit(found, target, weight):
    """JᵀWJ, JᵀWr and Σ w·r² from a stored Jacobian."""
    r = (found.values - target)[found.valid].double()
    j, w = found.derivatives[found.valid].double(), weight[found.valid].double()
    return (
        torch.einsum("n,nkp,nkq->pq", w, j, j),
        torch.einsum("n,nkp,nk->p", w, j, r),
        (w[:, None] * r * r).sum(),
    )


def close(a, b, relative):
    return bool((a - b).abs().max() <= relative * b.abs().max())


def test_sums_of_single_precision_are_double(root):
    name = root / "conf/lens/cooke_triplet.yaml"
    exact, lens = load_lens(name), load_lens(name, dtype=torch.float32)
    expected = normal_equations(exact, wide_bundle(exact, count=2000), EVERY)
    found = normal_equations(lens, wide_bundle(exact, count=2000, dtype=torch.float32), EVERY)
    assert found.jtj.dtype == torch.float64
    # A ray at an aperture's edge may pass in one precision only.
    assert close(found.jtj, expected.jtj, 1e-2)


def bundle_for_sums(lens, backend="auto"):
    """Rays of several chunks, with weights, targets near their points, and groups."""
    count = 5000 if backend == "auto" else 400
    rays = wide_bundle(lens, count=count)
    generator = torch.Generator().manual_seed(5)
    weight = torch.rand(count, generator=generator, dtype=torch.float64)
    target = 1e-2 * torch.randn((count, 3), generator=generator, dtype=torch.float64)
    group = torch.arange(count) * 7 // count * 2  # runs of even numbers: odd groups are empty
    group[::11] = 3
    target = target + ray_jacobian(lens, rays, ["sensor_distance"], ALL).values
    return rays, target, weight, group


def test_normal_equations_are_sums_over_the_jacobian(any_lens, backend):
    rays, target, weight, _ = bundle_for_sums(any_lens, backend)
    any_lens.backend = backend
    stored = ray_jacobian(any_lens, rays, EVERY, ALL)
    jtj, jtr, squares = explicit(stored, target, weight)
    found = normal_equations(any_lens, rays, EVERY, target, weight, outputs=ALL)
    assert int(found.count) == int(stored.valid.sum())
    assert found.columns == stored.columns
    assert found.groups is None
    assert close(found.jtj, jtj, 1e-12)
    assert close(found.jtr, jtr, 1e-12)
    assert close(found.sum_of_squares, squares, 1e-12)


def test_residuals_about_the_centroid_of_every_group(root, backend):
    lens = load_lens(root / "conf/lens/asphere.yaml")
    rays, target, weight, group = bundle_for_sums(lens, backend)
    lens.backend = backend
    stored = ray_jacobian(lens, rays, EVERY, ALL)
    found = normal_equations(lens, rays, EVERY, target, weight, group, ALL)
    residual, jacobian = (stored.values - target).clone(), stored.derivatives.clone()
    for g in range(13):
        chosen = stored.valid & (group == g)
        w = weight[chosen]
        assert int(found.groups.count[g]) == int(chosen.sum())
        assert close(found.groups.weight[g], w.sum(), 1e-12)
        if not chosen.any():
            assert not found.groups.jacobian[g].any()
            continue
        total = torch.einsum("n,nkp->kp", w, jacobian[chosen])
        assert close(found.groups.jacobian[g], total, 1e-12)
        share = w / w.sum()
        residual[chosen] -= torch.einsum("n,nk->k", share, residual[chosen])
        jacobian[chosen] -= torch.einsum("n,nkp->kp", share, jacobian[chosen])
    r, j, w = residual[stored.valid], jacobian[stored.valid], weight[stored.valid]
    centred = found.about_centroids()
    assert close(centred.jtj, torch.einsum("n,nkp,nkq->pq", w, j, j), 1e-10)
    assert close(centred.jtr, torch.einsum("n,nkp,nk->p", w, j, r), 1e-10)
    assert close(centred.sum_of_squares, (w[:, None] * r * r).sum(), 1e-10)
    assert int((found.groups.count == 0).sum()) == 5


def test_a_spot_radius_by_groups(root, backend):
    """The RMS radius of two fields, each about its own centroid."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    lens.backend = backend
    position = wide_bundle(lens, count=200).position
    tangent = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.1, 1.0]]).double()
    direction = (tangent / tangent.norm(dim=-1, keepdim=True))[:, None]
    rays = Rays(position.expand(2, 200, 3), direction)
    found = normal_equations(
        lens, rays, ["thicknesses.*"], group=torch.tensor([[0], [1]])
    ).about_centroids()
    hit = lens.trace(rays)
    squares = 0.0
    for field in range(2):
        spot = hit.position[field, hit.valid[field], :2].detach()
        squares += float((spot - spot.mean(0)).square().sum())
    assert float(found.sum_of_squares) == pytest.approx(squares, rel=1e-9)


def test_the_same_to_the_bit_with_any_number_of_threads(any_lens):
    rays, target, weight, group = bundle_for_sums(any_lens)
    kept = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 2, 3):
            torch.set_num_threads(threads)
            sums = normal_equations(any_lens, rays, EVERY, target, weight, group, ALL)
            stored = ray_jacobian(any_lens, rays, EVERY, ALL)
            results.append((sums.jtj, sums.jtr, sums.groups.jacobian, stored.derivatives))
    finally:
        torch.set_num_threads(kept)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_step_of_gauss_and_newton_refocuses(root, backend):
    """From the sums alone: the sensor of a defocused lens goes back."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    lens.backend = backend
    position = 0.4 * wide_bundle(lens, count=400).position
    rays = Rays(position, torch.tensor([0.0, 0.0, 1.0]).double())
    group = torch.zeros((), dtype=torch.int64)

    def sums():
        return normal_equations(lens, rays, ["sensor_distance"], group=group).about_centroids()

    def refocus():
        found = sums()
        lens.sensor_distance -= (found.jtr / found.jtj[0]).reshape(())
        return float(lens.sensor_distance), float(found.jtr.abs())

    with torch.no_grad():
        best, _ = refocus()
        lens.sensor_distance += 0.5
        again, slope = refocus()
        # A ray goes straight to the sensor, so one step is exact.
        assert again == pytest.approx(best, abs=1e-9)
        assert float(sums().jtr.abs()) < 1e-9 * slope


def test_wrong_input_is_refused(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    rays = wide_bundle(lens, count=4)
    for names, outputs, said in (
        (["surfaces.9.curvature"], ("x", "y"), "no parameter 'surfaces"),
        (EVERY, ("z",), "path_length"),
    ):
        with pytest.raises(InputError, match=said):
            ray_jacobian(lens, rays, names, outputs)
    for given, said in (
        ({"target": torch.zeros(4, 3)}, "target must broadcast"),
        ({"weight": torch.ones(3)}, "weight must broadcast"),
        ({"group": torch.zeros(4)}, "integers"),
        ({"group": torch.tensor(-1)}, "count from 0"),
    ):
        with pytest.raises(InputError, match=said):
            normal_equations(lens, rays, EVERY, **given)
    with pytest.raises(InputError, match="groups"):
        normal_equations(lens, rays, EVERY).about_centroids()
