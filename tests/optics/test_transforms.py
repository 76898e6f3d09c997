"""The trace under torch.func: forward mode, second derivatives, batches of lenses."""

import pytest
import torch
import yaml
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vmap

from dolens import Rays
from dolens.prescriptions import lens_from_prescription

EVERY = ["surfaces.*", "thicknesses.*", "sensor_distance"]


def sensor_points(lens, rays, names):
    """Parameters as one vector → sensor points, for `torch.func`."""
    stored = lens.variables(names)

    def function(vector):
        values = dict(zip(stored, vector.unbind(), strict=True))
        return functional_call(lens, values, (rays,)).position[..., :2]

    return function, torch.stack([p.detach() for p in stored.values()])


def test_forward_mode_is_reverse_mode(bent_lens, bundle):
    function, x = sensor_points(bent_lens, bundle(bent_lens), EVERY)
    forward, reverse = jacfwd(function)(x), jacrev(function)(x)
    assert forward.abs().amax(dim=(0, 1)).min() > 0.0
    scale = reverse.abs().amax(dim=(0, 1))
    assert ((forward - reverse).abs().amax(dim=(0, 1)) / scale).max() < 1e-12


def test_forward_mode_needs_no_grad_mode(bent_lens, bundle):
    function, x = sensor_points(bent_lens, bundle(bent_lens), EVERY)
    direction = torch.linspace(-1.0, 1.0, len(x), dtype=x.dtype) * x.abs()
    expected = jvp(function, (x,), (direction,))[1]
    with torch.no_grad():
        assert torch.equal(jvp(function, (x,), (direction,))[1], expected)
    assert expected.abs().min() > 0.0


def test_a_batch_of_lenses_is_each_lens_alone(bent_lens, bundle):
    function, x = sensor_points(bent_lens, bundle(bent_lens), EVERY)
    generator = torch.Generator().manual_seed(1)
    lenses = x * (1.0 + 1e-3 * torch.randn((5, len(x)), generator=generator, dtype=x.dtype))
    together = vmap(function)(lenses)
    assert together.shape == (5, 7, 2)
    for lens, found in zip(lenses, together, strict=True):
        assert (found - function(lens)).abs().max() < 1e-13
    assert (together[0] - together[1]).abs().min() > 0.0


def test_gradients_of_a_batch_of_lenses(bent_lens, bundle):
    function, x = sensor_points(bent_lens, bundle(bent_lens), EVERY)
    lenses = x * torch.tensor([[0.999], [1.0], [1.001]], dtype=x.dtype)

    def spread(vector):
        points = function(vector)
        return (points - points.mean(0)).square().sum()

    together = vmap(grad(spread))(lenses)
    for lens, found in zip(lenses, together, strict=True):
        assert torch.allclose(found, grad(spread)(lens), rtol=1e-9, atol=0.0)


def test_one_bundle_a_lens(bent_lens, bundle):
    """Rays may be batched with the lenses, or alone."""
    rays = bundle(bent_lens)
    position = rays.position + torch.tensor([0.0, 0.1, -0.2]).double()[:, None, None]

    def trace(position):
        return bent_lens.trace(Rays(position, rays.direction, rays.wavelength)).position

    together = vmap(trace)(position)
    for start, found in zip(position, together, strict=True):
        assert (trace(start) - found).abs().max() < 1e-13


def test_second_derivatives_are_differences_of_first(bent_lens, bundle):
    names = [n for n in dict(bent_lens.named_parameters()) if n.startswith("surfaces")]
    function, x = sensor_points(bent_lens, bundle(bent_lens, count=3), names)

    def total(vector):
        return (function(vector) * torch.tensor([[1.0, 0.3]]).double()).sum()

    second = hessian(total)(x)
    assert torch.allclose(second, second.mT, rtol=1e-7, atol=1e-9 * float(second.abs().max()))
    for i in range(len(x)):
        step = torch.zeros_like(x)
        step[i] = 1e-4 * abs(float(x[i])) or 1e-6  # the latter for a plane's curvature
        ends = [grad(total)(x + k * step) for k in (-2, -1, 1, 2)]
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * float(step[i]))
        scale = float(second[i].abs().max())
        assert (difference - second[i]).abs().max() < 1e-5 * scale, names[i]


def test_double_backward_through_the_rays(bent_lens, bundle):
    bent_lens.backend = "reference"
    rays = bundle(bent_lens, count=3)

    def path(position, direction):
        unit = direction / direction.norm(dim=-1, keepdim=True)
        return bent_lens.trace(Rays(position, unit, 550.0)).path_length

    inputs = [t.clone().requires_grad_() for t in (rays.position, rays.direction)]
    assert torch.autograd.gradgradcheck(path, inputs, atol=1e-6, rtol=1e-4)


def test_a_batch_of_freeforms(bundle):
    """Coefficients are arrays: each lens of the batch looks up its own."""
    row = [-0.01 * (3 * (i - 2.4) ** 2 + i) for i in range(6)]
    spline = {
        "type": "b_spline",
        "half_width": 10.0,
        "semi_diameter": 9.0,
        "material": "air",
        "coefficients": [[h - 0.02 * (j - 3.1) ** 2 for h in row] for j in range(7)],
    }
    front = {"radius": 40.0, "semi_diameter": 9.0, "thickness": 5.0, "material": "1.5168/64.17"}
    lens = lens_from_prescription(
        {"surfaces": {"1": front, "2": spline}, "sensor": {"distance": 45.0}}
    )  # fmt: skip
    rays = bundle(lens)
    name = "surfaces.2.coefficients"
    stored = lens.variables([name])[name].detach()

    def points(coefficients):
        return functional_call(lens, {name: coefficients}, (rays,)).position[..., :2]

    assert lens.trace(rays).valid.all()
    several = stored * torch.tensor([0.9, 1.0, 1.1]).double()[:, None, None]
    together = vmap(points)(several)
    for alone, found in zip(several, together, strict=True):
        assert (points(alone) - found).abs().max() < 1e-13
    forward, reverse = jacfwd(points)(stored), jacrev(points)(stored)
    assert (forward - reverse).abs().max() < 1e-12 * forward.abs().max()
    assert int((forward.abs().amax(dim=(0, 1)) > 0).sum()) >= 16
    lens.backend = "reference"
    inputs = stored.clone().requires_grad_()
    assert torch.autograd.gradgradcheck(points, inputs, atol=1e-6, rtol=1e-4)


def test_poses_under_every_transform(root):
    text = (root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8")
    elements = {"1": {"surfaces": [1, 2], "tilt_x": 0.5}, "2": {"surfaces": [3, 4], "shift_z": 0.1}}
    lens = lens_from_prescription(yaml.safe_load(text) | {"elements": elements})
    axis = torch.tensor([[0.0, 0.0, -5.0], [1.0, 2.0, -5.0]], dtype=torch.float64)
    rays = Rays(axis, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    function, x = sensor_points(lens, rays, ["elements.*"])
    forward = jacfwd(function)(x)
    assert torch.allclose(forward, jacrev(function)(x), rtol=1e-11, atol=1e-13)
    assert vmap(function)(x.expand(3, -1)).shape == (3, 2, 2)
    assert hessian(lambda v: function(v).sum())(x).isfinite().all()
    assert forward.abs().max() > 0.1


@pytest.mark.parametrize("shape", [(0,), (1,), (2, 3), ()])
def test_any_leading_shape(bent_lens, shape):
    position = torch.zeros((*shape, 3), dtype=torch.float64)
    position[..., 2] = -1.0
    hit = bent_lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0]).double()), record=True)
    assert hit.position.shape == (*shape, 3)
    assert hit.valid.shape == hit.status.shape == hit.path_length.shape == shape
    assert hit.points.shape == (len(bent_lens.surfaces), *shape, 3)
    assert bool(hit.valid.all())
