"""Jacobians of every ray, on the kernels and on the reference alike."""

import pytest
import torch

from dolens import InputError, Rays, load_lens
from dolens.optics.jacobian import normal_equations, ray_jacobian
from tests.optics.jacobian_samples import (
    ALL,
    EVERY,
    freeform,
    posed_triplet,
    sample_lens,
    wide_bundle,
)


@pytest.fixture(params=["asphere", "posed", "freeform"])
def any_lens(request, root):
    return sample_lens(request.param, root)


@pytest.fixture(params=["auto", "reference"])
def backend(request):
    return request.param


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


def test_wrong_input_is_refused(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    rays = wide_bundle(lens, count=4)
    with pytest.raises(InputError, match="no parameter 'surfaces"):
        ray_jacobian(lens, rays, ["surfaces.9.curvature"])
    with pytest.raises(InputError, match="path_length"):
        ray_jacobian(lens, rays, EVERY, ("z",))
