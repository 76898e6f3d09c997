"""A lens is traced as it is now, eagerly and by the operator: nothing else is kept of it."""

import copy
import dataclasses
import pickle

import pytest
import torch
import yaml
from torch.func import functional_call

from dolens import InputError, Rays, load_lens
from dolens.optics import ray_tracing
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.packing import pack
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.optics.surfaces.conic import Conic, Sphere
from dolens.optics.surfaces.phase import Grating
from dolens.optics.surfaces.xy_polynomial import XYPolynomial
from dolens.prescriptions import lens_from_prescription

WAVE = 587.5618


def bundle(dtype=torch.float64, count=300):
    generator = torch.Generator().manual_seed(4)
    xy = 12.0 * torch.rand((count, 2), generator=generator, dtype=torch.float64) - 6.0
    position = torch.cat((xy, torch.full((count, 1), -5.0, dtype=torch.float64)), 1)
    direction = torch.tensor([0.03, 0.05, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(count, 3)
    return Rays(position.to(dtype), direction.to(dtype), WAVE)


def triplet(root, dtype=torch.float64):
    return load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=dtype, backend="cpu")


def tilted(root, dtype):
    given = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8"))
    given["elements"] = {"rear": {"surfaces": [5, 6], "decenter_x": 0.1, "tilt_y": 0.01}}
    return lens_from_prescription(given, dtype)


def spline(root, dtype):
    sag = [[0.01 * (i - 3.5) ** 2 + 0.008 * (j - 3.5) ** 2 for i in range(8)] for j in range(8)]
    front = {"type": "b_spline", "coefficients": sag, "half_width": 9.0, "semi_diameter": 8.0}
    surfaces = {"1": {**front, "material": "1.5168/64.17", "thickness": 4.0}}
    back = {"type": "sphere", "radius": -80.0, "semi_diameter": 8.0, "material": "air"}
    surfaces["2"] = back
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 40.0}}, dtype)


def everything(lens, rays):
    """Rays, and the gradients of lens, rays and wavelengths."""
    hit = lens.trace(rays)
    total = hit.position.square().sum() + hit.path_length.sum() + hit.direction[:, 1].sum()
    given = [t for t in (rays.position, rays.direction, rays.wavelength) if torch.is_tensor(t)]
    wanted = [*lens.parameters(), *(t for t in given if t.requires_grad)]
    gradients = torch.autograd.grad(total, wanted, allow_unused=True)
    return [hit.position, hit.direction, hit.path_length, hit.status, hit.surface, *gradients]


@pytest.mark.parametrize("make", [triplet, tilted, spline])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_operator_gives_the_same_bits(root, make, dtype, monkeypatch):
    lens, rays = make(root, dtype), bundle(dtype)
    lens.backend = "cpu"
    leaf = dataclasses.replace(rays, position=rays.position.clone().requires_grad_())
    waves = torch.linspace(480.0, 650.0, 300, dtype=torch.float64).requires_grad_()
    cases = [rays, leaf, dataclasses.replace(rays, wavelength=waves)]
    found = [everything(lens, case) for case in cases]
    monkeypatch.setattr(ray_tracing, "traces_eagerly", lambda *_: False)
    for case, ours in zip(cases, found, strict=True):
        for a, b in zip(ours, everything(lens, case), strict=True):
            assert (a is None) == (b is None)
            assert a is None or (a.dtype == b.dtype and torch.equal(a, b))


def test_a_batch_of_gradients(root):
    """PyTorch maps the backward pass over them, which an operator can be."""
    lens, rays = triplet(root), bundle()
    position = lens.trace(rays).position
    cotangents = torch.randn(
        (3, *position.shape), generator=torch.Generator().manual_seed(1)
    ).double()
    wanted = [lens.surfaces["2"].curvature, lens.thicknesses["1"]]
    options = {"retain_graph": True}
    together = torch.autograd.grad(position, wanted, cotangents, is_grads_batched=True, **options)
    for i, cotangent in enumerate(cotangents):
        alone = torch.autograd.grad(position, wanted, cotangent, **options)
        for a, b in zip(together, alone, strict=True):
            assert torch.allclose(a[i], b, rtol=1e-12)


def exchange_parameter(lens):
    """One that begins with the same number."""
    surface = lens.surfaces["2"]
    surface.curvature = torch.nn.Parameter(surface.curvature.detach().clone())
    lens.trace(bundle())
    with torch.no_grad():
        surface.curvature *= 1.2


def exchange_surface(lens):
    old = lens.surfaces["3"]
    curvature = 1.1 * old.curvature.item()
    new = Conic(old.aperture, {"curvature": curvature, "conic": 0.4}, lens.dtype)
    lens.surfaces["3"] = new


def change_the_materials(lens):
    before, _, *behind = lens.materials
    lens.materials = [before, lens.materials[3], *behind]


def change_data(lens):
    curvature = lens.surfaces["1"].curvature
    curvature.data = 1.1 * curvature.data


def change_precision(lens):
    lens.to(torch.float32)
    lens.trace(bundle(torch.float32))
    lens.to(torch.float64)
    change_data(lens)


def rule_a_grating(lens):
    lens.surfaces["6"].phase = Grating({"grooves": 2.0, "order": 1}, lens.dtype)


def drop_reversals(lens):
    lens.fields = None
    change_data(lens)


def change_aperture(lens):
    lens.surfaces["2"].aperture = ClearAperture(Circle(3.0), Circle(1.0))


def change_material(lens):
    materials = list(lens.materials)
    materials[1], materials[5] = materials[3], materials[3]
    lens.materials = tuple(materials)


def change_gap(lens):
    with torch.no_grad():
        lens.thicknesses["2"] += 0.3


def change_pose(lens):
    with torch.no_grad():
        lens.elements["rear"].tilt_x += 0.01


POSED = [change_aperture, change_material, change_gap, change_pose]  # of a lens with an element
CHANGES = [exchange_parameter, exchange_surface, change_the_materials, change_data]
CHANGES += [change_precision, rule_a_grating, drop_reversals, *POSED]


@pytest.mark.parametrize("change", CHANGES)
def test_a_lens_is_traced_as_it_is_now(root, change):
    posed = change in POSED
    lens = tilted(root, torch.float64) if posed else triplet(root)
    lens.backend = "cpu"
    names = ["surfaces.*.curvature", *["elements.rear.tilt_x"] * posed]
    before = lens.trace(bundle())
    ray_jacobian(lens, bundle(), names)
    change(lens)
    found, moved = everything(lens, bundle()), ray_jacobian(lens, bundle(), names)
    lens.backend = "reference"
    expected, slopes = everything(lens, bundle()), ray_jacobian(lens, bundle(), names)
    assert (moved.derivatives - slopes.derivatives).abs().max() < 1e-9
    different = (found[0] - before.position).abs().max() > 1e-3
    assert different or not torch.equal(found[3], before.status)
    assert torch.equal(found[3], expected[3])
    for a, b in zip(found[5:], expected[5:], strict=True):
        # A sum over rays rounds by 1e-12; a tilt about a lens's own axis moves nothing else.
        assert torch.allclose(a, b, rtol=1e-8, atol=1e-9 * float(b.abs().max()) + 1e-11)
    valid = found[3] == 0
    assert (found[0] - expected[0])[valid].abs().max() < 1e-11


def test_nothing_stays_of_values_that_a_call_was_given(root):
    """Neither the numbers nor their graph, which would keep its memory."""
    lens, rays = triplet(root), bundle()
    before = lens.trace(rays).position
    system = lens.system()
    assert lens.system() is system
    stored = lens.surfaces["1"].curvature.detach()
    value = (1.1 * stored).requires_grad_() * 1.0
    moved = functional_call(lens, {"surfaces.1.curvature": value}, (rays,)).position
    assert (moved - before).abs().max() > 1e-3
    assert lens.system() is system
    assert torch.equal(lens.trace(rays).position, before)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda lens: pickle.loads(pickle.dumps(lens))])
def test_a_copy_has_its_own_numbers(root, copied):
    lens, rays = triplet(root), bundle()
    before = lens.trace(rays).position
    other = copied(lens)
    change_data(other)
    assert (other.trace(rays).position - before).abs().max() > 1e-3
    assert torch.equal(lens.trace(rays).position, before)


def test_numbers_kept_from_inference_mode_serve_training(root):
    lens, rays = triplet(root), bundle()
    with torch.inference_mode():
        lens.trace(rays)
    lens.trace(rays).path_length.sum().backward()
    assert lens.surfaces["1"].curvature.grad is not None


def test_a_shallow_copy_with_tables_of_its_own_is_another_lens(root):
    """Replicas of a module are made so: they share all else with it."""
    lens, rays = triplet(root), bundle()
    before = lens.trace(rays).position
    other = copy.copy(lens)
    other._parameters = dict(lens._parameters)
    other.sensor_distance = torch.nn.Parameter(1.1 * lens.sensor_distance.detach())
    assert (other.trace(rays).position - before).abs().max() > 1e-3
    assert torch.equal(lens.trace(rays).position, before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_number_has_its_own_derivative(root, dtype):
    """Whatever the place in memory of the numbers, and which of them ask for one."""
    lens, rays = triplet(root, dtype), bundle(dtype)
    names = list(dict(lens.named_parameters()))
    everyone = torch.autograd.grad(lens.trace(rays).position[:, 0].sum(), list(lens.parameters()))
    together = torch.stack([p.detach() for p in lens.parameters()])
    for number, parameter in zip(together, lens.parameters(), strict=True):
        parameter.data = number
    for name, expected in zip(names, everyone, strict=True):
        lens.requires_grad_(False)
        parameter = lens.get_parameter(name).requires_grad_()
        lens.trace(rays).position[:, 0].sum().backward()
        assert torch.equal(parameter.grad, expected)
        others = (p.grad for n, p in lens.named_parameters() if n != name)
        assert all(grad is None for grad in others)
        parameter.grad = None


class Bent(Sphere):
    """A sphere whose kernel is given a curvature that depends on the number itself."""

    kind = "bent"

    @classmethod
    def packed(cls, p):
        shape = super().packed(p)
        negative = bool(p["curvature"] < 0.0)
        return shape._replace(numbers=(None,)) if negative else shape


def test_an_own_shape_is_asked_again_at_every_trace(root):
    """Its numbers may depend on more than names."""
    Bent.kernel = Sphere.kernel
    lens, rays = triplet(root), bundle()
    old = lens.surfaces["1"]
    lens.surfaces["1"] = Bent(old.aperture, {"curvature": old.curvature.item()}, lens.dtype)
    assert torch.equal(lens.trace(rays).position, triplet(root).trace(rays).position)
    with torch.no_grad():
        lens.surfaces["1"].curvature.neg_()
    flat = triplet(root)
    with torch.no_grad():
        flat.surfaces["1"].curvature.zero_()
    assert torch.equal(lens.trace(rays).position, flat.trace(rays).position)


class Leaning(XYPolynomial):
    """A polynomial on a wedge that no kernel knows of."""

    kind = "leaning"

    @classmethod
    def sag_and_gradient(cls, p, x, y):
        sag, sx, sy, exists = super().sag_and_gradient(p, x, y)
        return sag + 0.05 * x, sx + 0.05, sy, exists


def test_a_kernel_is_not_inherited_by_another_sag(registered):
    registered(Leaning)
    surface = {"type": "leaning", "x2": 0.01, "semi_diameter": 8.0, "material": "1.5"}
    lens = lens_from_prescription({"surfaces": {"1": surface}, "sensor": {"distance": 20.0}})
    rays = dataclasses.replace(bundle(), direction=torch.tensor([[0.0, 0.0, 1.0]]).double())
    # Light bends towards the thicker side by (1 - 1/n) of the wedge's angle, to first order.
    slope = lens.trace(rays).direction[..., 0].detach() + 0.02 * rays.position[..., 0] / 3.0
    assert slope.mean() == pytest.approx(-0.05 / 3.0, rel=0.02)
    lens.backend = "cpu"
    with pytest.raises(InputError, match=r"surface 1 \(leaning\) has no kernel"):
        lens.trace(rays)


def test_a_law_without_a_kernel_is_named(monkeypatch):
    monkeypatch.setattr(Grating, "kernel", None)
    phase = {"type": "grating", "grooves": 100.0}
    surface = {"type": "plane", "semi_diameter": 8.0, "material": "1.5", "phase": phase}
    lens = lens_from_prescription({"surfaces": {"1": surface}, "sensor": {"distance": 20.0}})
    with pytest.raises(InputError, match="surface 1: a grating has no kernel"):
        pack(lens.system(), 550.0, 1.0, 1, 1, True)
