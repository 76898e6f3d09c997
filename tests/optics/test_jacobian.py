"""Jacobians of every ray and normal equations, on the kernels and on the reference alike."""

import pytest
import torch
import yaml

from dolens import InputError, Rays, load_lens
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.prescriptions import lens_from_prescription

ALL = ("x", "y", "path_length")
EVERY = ["surfaces.*", "thicknesses.*", "sensor_distance"]


def posed_triplet(root):
    """A Cooke triplet of three elements out of place; the second lies within a moved group."""
    text = (root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8")
    elements = {
        "front": {"surfaces": [1, 2], "tilt_x": 0.5, "decenter_y": 0.1, "pivot": [0.0, 0.2, 1.0]},
        "group": {"surfaces": [3, 6], "tilt_y": -0.4, "tilt_z": 3.0, "shift_z": 0.05},
        "inner": {"surfaces": [3, 4], "tilt_x": 0.3, "pivot": [-0.4, 0.0, 0.0]},
    }
    return lens_from_prescription(yaml.safe_load(text) | {"elements": elements})


def freeform():
    """A singlet with a B-spline back of 7×6 coefficients, of which a pencil meets a few."""
    row = [-0.01 * (3 * (i - 2.4) ** 2 + i) for i in range(6)]
    spline = {
        "type": "b_spline", "half_width": 10.0, "semi_diameter": 9.0, "material": "air",
        "coefficients": [[h - 0.02 * (j - 3.1) ** 2 for h in row] for j in range(7)],
    }  # fmt: skip
    front = {
        "type": "conic", "radius": 40.0, "conic": -0.4, "semi_diameter": 9.0, "thickness": 5.0,
        "material": "1.5168/64.17",
    }  # fmt: skip
    return lens_from_prescription(
        {"surfaces": {"1": front, "2": spline}, "sensor": {"distance": 45.0}}
    )


@pytest.fixture(params=["bent", "posed", "freeform"])
def any_lens(request, root):
    """Lenses that have every kind of parameter; `bent` is several."""
    if request.param == "posed":
        return posed_triplet(root)
    if request.param == "freeform":
        return freeform()
    return load_lens(root / "conf/lens/asphere.yaml")


@pytest.fixture(params=["auto", "reference"])
def backend(request):
    return request.param


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


def traced(lens, rays, values):
    """(..., 3): x, y and path length with some parameters replaced, by the reference."""
    lens.backend, kept = "reference", lens.backend
    hit = torch.func.functional_call(lens, values, (rays,))
    lens.backend = kept
    return torch.cat((hit.position[..., :2], hit.path_length[..., None]), -1).detach()


def difference(lens, rays, name, entry, step):
    """Fourth-order central difference in one entry of a parameter."""
    stored = lens.variables([name])[name].detach()
    ends = []
    for k in (-2, -1, 1, 2):
        moved = stored.clone()
        moved.view(-1)[entry] += k * step
        ends.append(traced(lens, rays, {name: moved}))
    return (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)


def agrees_with_differences(lens, rays, patterns):
    """Every column against differences whose step moves a ray by about a micrometre.

    Returns how many are not zero.
    """
    found = ray_jacobian(lens, rays, patterns, ALL)
    assert found.valid.all()
    checked = 0
    for name, columns in found.columns.items():
        for entry, column in enumerate(range(columns.start, columns.stop)):
            exact = found.derivatives[..., column]
            largest = float(exact.abs().max())
            if largest == 0.0:
                continue
            step = min(1e-3 / largest, 1e-2 if "tilt" in name else 1e3)
            measured = difference(lens, rays, name, entry, step)
            assert (measured - exact).abs().max() < 1e-8 * largest, (name, entry)
            checked += 1
    return checked


def test_every_parameter_of_a_shape_against_differences(bent_lens, bundle):
    count = len(dict(bent_lens.named_parameters()))
    assert agrees_with_differences(bent_lens, bundle(bent_lens), EVERY) == count


def test_poses_against_differences(root, bundle):
    lens = posed_triplet(root)
    rays = bundle(lens, fill=0.3)
    assert agrees_with_differences(lens, rays, ["elements.*"]) == 18
    # The gaps move vertices that elements turn about.
    assert agrees_with_differences(lens, rays, ["thicknesses.*", "surfaces.*"]) == 11


def test_spline_coefficients_against_differences(bundle):
    lens = freeform()
    rays = bundle(lens)
    checked = agrees_with_differences(lens, rays, ["surfaces.2.coefficients", "surfaces.1.conic"])
    # Those that no ray comes near have columns of zeros.
    assert 16 <= checked - 1 < lens.surfaces["2"].coefficients.numel()


def test_kernels_are_the_reference(any_lens):
    rays = wide_bundle(any_lens)
    names = ["surfaces.*", "thicknesses.*", "sensor_distance"]
    names += ["elements.*"] if any_lens.elements else []
    fast = ray_jacobian(any_lens, rays, names, ALL)
    any_lens.backend = "reference"
    slow = ray_jacobian(any_lens, rays, names, ALL)
    assert torch.equal(fast.valid, slow.valid)
    assert 20 < int(fast.valid.sum()) < len(fast.valid)
    assert fast.columns == slow.columns
    assert (fast.values - slow.values).abs().max() < 1e-11
    scale = slow.derivatives.abs().amax(0)
    error = (fast.derivatives - slow.derivatives).abs().amax(0)
    assert (error <= 1e-11 * scale).all()


def test_the_nikon_lens_of_the_paper(root):
    """Its 22 variables: curvatures, conic constants and r⁴ coefficients."""
    lens = load_lens(root / "conf/lens/nikon.yaml")
    surfaces = [*range(1, 12), *range(13, 20)]
    names = [f"surfaces.{n}.curvature" for n in surfaces]
    names += [f"surfaces.{n}.{name}" for n in (17, 18) for name in ("conic", "a4")]
    rays = wide_bundle(lens, count=1000)
    fast = ray_jacobian(lens, rays, names)
    lens.backend = "reference"
    slow = ray_jacobian(lens, rays, names)
    assert fast.derivatives.shape == (1000, 2, 22)
    assert torch.equal(fast.valid, slow.valid)
    assert 100 < int(fast.valid.sum()) < 900
    scale = slow.derivatives.abs().amax(0)
    assert ((fast.derivatives - slow.derivatives).abs().amax(0) / scale).max() < 1e-11


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
    sums = normal_equations(lens, single, EVERY)
    assert sums.jtj.dtype == torch.float64
    assert close(sums.jtj, normal_equations(exact, rays, EVERY).jtj, 1e-2)


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
    with pytest.raises(InputError, match="no parameter 'surfaces"):
        ray_jacobian(lens, rays, ["surfaces.9.curvature"])
    with pytest.raises(InputError, match="path_length"):
        ray_jacobian(lens, rays, EVERY, ("z",))
    with pytest.raises(InputError, match="target must broadcast"):
        normal_equations(lens, rays, EVERY, torch.zeros(4, 3))
    with pytest.raises(InputError, match="weight must broadcast"):
        normal_equations(lens, rays, EVERY, weight=torch.ones(3))
    with pytest.raises(InputError, match="integers"):
        normal_equations(lens, rays, EVERY, group=torch.zeros(4))
    with pytest.raises(InputError, match="count from 0"):
        normal_equations(lens, rays, EVERY, group=torch.tensor(-1))
    with pytest.raises(InputError, match="groups"):
        normal_equations(lens, rays, EVERY).about_centroids()
