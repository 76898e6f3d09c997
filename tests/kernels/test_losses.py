"""The share of light that surfaces and media leave, by the CPU kernels: values and derivatives."""

from dataclasses import replace

import pytest
import torch

from dolens import InputError, Rays
from dolens.kernels import operators
from dolens.kernels.cpu import losses as kernels
from dolens.kernels.table import Cosine
from dolens.optics.elements import from_lens_axes
from dolens.optics.ghost_paths import ghost_path_systems, with_losses
from dolens.optics.losses import Losses, loss_table, losses_of, nodes, series
from dolens.optics.packing import lay_out
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components
from dolens.optics.surfaces.clear_aperture import ClearAperture, Unlimited
from dolens.prescriptions.build import lens_from_prescription
from tests.kernels.trace_cases import LENSES, bundle, returning

F64 = torch.float64
# Kinds of surfaces and steps; others share the kernels of these.
NAMES = ("cooke_triplet", "wavefront_coding", "posed", "b_spline", "even_aspheres", "zernike",
         "own_surface", "diffractive", "spectrometer", "mirrors", "folded", "retina")  # fmt: skip


def drawn(lens, wavelengths=1, terms=8, lowest=0.0):
    """Losses of every surface that light meets, of all kinds, which no coating has."""
    system, generator = lens.system(), torch.Generator().manual_seed(2)
    numbers = system.met
    shape = (len(numbers), wavelengths)
    coefficients = 0.1 * torch.randn(*shape, terms, generator=generator, dtype=F64)
    # Those that converge are summed by powers, and others, here of many terms, are not.
    coefficients *= (0.4 if terms <= 16 else 1.0) ** torch.arange(terms)
    coefficients[..., 0] += 0.8
    kinds = (Cosine.LEAVING, Cosine.ARRIVING, Cosine.BEYOND)
    cosines = tuple(
        kinds[(k + (n not in system.mirrors)) % 2 + (n in system.mirrors)]
        for k, n in enumerate(numbers)
    )
    media = len(system.surfaces) + 1
    return Losses(
        numbers,
        coefficients.requires_grad_(),
        cosines,
        (lowest,) * len(numbers),
        (1.0 + 0.2 * torch.rand(shape, generator=generator, dtype=F64)).requires_grad_(),
        (0.02 * torch.rand(media, wavelengths, generator=generator, dtype=F64)).requires_grad_(),
    )


def expected_share(lens, rays, losses, sense=1.0, column=0):
    """The same by traces to every surface in turn, normals and exponentials, in PyTorch."""
    system = lens.system().traced_by("reference")
    count = len(system.surfaces)
    order = system.met if sense > 0.0 else system.met[::-1]
    at = direction = None
    if not system.breaks or sense > 0.0:
        at, direction = rays.position, rays.direction
    total, path = 1.0, 0.0
    indices = system.indices(rays.wavelength)
    for number in order:
        span = {"last": number} if sense > 0.0 else {"first": number, "last": count}
        hit = trace_rays(system, rays, sense, **span)
        front = number - 1 if sense > 0.0 else number
        t = ((hit.position - at) * direction).sum(-1)
        total = total * torch.exp(-losses.absorption[front, column] * t)
        place = losses.numbers.index(number)
        surface, axes = system.surfaces[number - 1], system.axes[number - 1]
        leaving = losses.cosines[place] == Cosine.LEAVING
        # A law deflects behind the surface, whose series is one of arriving light.
        d = direction if surface.deflection is not None or not leaving else hit.direction
        here = from_lens_axes(Components(*hit.position.unbind(-1), *d.unbind(-1)), axes)
        normal = surface.shape.normal(surface.parameters, *here[:3])
        u = sum(a * b for a, b in zip(here[3:], normal, strict=True)).abs()
        if losses.cosines[place] == Cosine.BEYOND:
            squared = 1.0 - losses.ratios[place, column] ** 2 * (1.0 - u * u)
            u = torch.where(squared > 0.0, squared.clamp(min=1e-18).sqrt(), 0.0)
        lowest = losses.lowest[place]
        x = 1.0 - 2.0 * (1.0 - u.clamp(min=lowest)) / (1.0 - lowest)
        before, polynomial, share = torch.ones_like(x), x, 0.0
        for c in losses.coefficients[place, column]:
            share = share + c * before
            before, polynomial = polynomial, 2.0 * x * polynomial - before
        total = total * share
        at, direction, path = hit.position, hit.direction, hit.path_length
    if sense > 0.0:
        t = (trace_rays(system, rays).path_length - path) / indices[-1]
        total = total * torch.exp(-losses.absorption[-1, column] * t)
    return total


def inputs_of(lens, rays, losses):
    """Whatever the share depends on."""
    named = {
        "position": rays.position,
        "direction": rays.direction,
        **dict(lens.named_parameters()),
    }
    more = {"coefficients": losses.coefficients, "ratios": losses.ratios}
    return named | more | {"absorption": losses.absorption}


def require_equal_slopes(total, expected, inputs, relative=1e-9):
    """Gradients of one number, found in two ways."""
    values = list(inputs.values())
    options = {"allow_unused": True, "materialize_grads": True, "retain_graph": True}
    for name, found, wanted in zip(
        inputs,
        torch.autograd.grad(total, values, **options),
        torch.autograd.grad(expected, values, **options),
        strict=True,
    ):
        if name == "direction":  # a unit vector moves across itself only
            along = inputs[name].detach()
            found, wanted = (g - (g * along).sum(-1, keepdim=True) * along for g in (found, wanted))
        error = (found - wanted).abs().max()
        assert error <= relative * (1e-4 + wanted.abs().max()), name


def free(rays):
    """The same rays, to be differentiated."""
    return replace(
        rays,
        position=rays.position.clone().requires_grad_(),
        direction=rays.direction.clone().requires_grad_(),
    )


@pytest.mark.parametrize("name", NAMES)
def test_shares_and_all_their_derivatives(name, root):
    lens = LENSES[name](root)
    lens.backend = "cpu"
    rays, losses = free(bundle(lens, 60)), drawn(lens)
    hit = trace_rays(lens.system(), rays, losses=losses)
    expected = expected_share(lens, rays, losses)
    valid = hit.valid
    assert 10 < valid.sum() < 60
    assert torch.isfinite(hit.transmission).all()
    assert (hit.transmission - expected)[valid].abs().max() < 1e-12
    # With the path and the place, whose cotangents pass through the same steps.
    reference = trace_rays(lens.system().traced_by("reference"), rays)
    weights = torch.linspace(-1.0, 1.0, 60, dtype=F64)
    totals = (
        torch.where(
            valid, weights * (share + 0.3 * one.path_length + one.position[:, 0]), 0.0
        ).sum()
        for share, one in ((hit.transmission, hit), (expected, reference))
    )
    require_equal_slopes(*totals, inputs_of(lens, rays, losses))


@pytest.mark.parametrize("name", ["cooke_triplet", "mirrors"])
def test_light_that_is_sent_back(name, root):
    lens = LENSES[name](root)
    lens.backend = "cpu"
    rays, losses = free(returning(lens, bundle(lens, 60))), drawn(lens)
    hit = trace_rays(lens.system(), rays, -1.0, losses=losses)
    expected = expected_share(lens, rays, losses, -1.0)
    assert (hit.transmission - expected)[hit.valid].abs().max() < 1e-12
    totals = (torch.where(hit.valid, s, 0.0).sum() for s in (hit.transmission, expected))
    require_equal_slopes(*totals, inputs_of(lens, rays, losses))


@pytest.mark.parametrize(("terms", "lowest"), [(3, 0.0), (20, 0.0), (12, 0.96)])
def test_series_of_any_length_from_any_cosine_on(terms, lowest, root):
    """Many terms are summed as Chebyshev polynomials; steeper light has the lowest's share."""
    lens = LENSES["cooke_triplet"](root)
    lens.backend = "cpu"
    rays, losses = free(bundle(lens, 60)), drawn(lens, terms=terms, lowest=lowest)
    found = lay_out(lens.system(), 1.0, 1, 6, True)
    assert bool((loss_table(losses, found, 1, 6).steps[:6, 2] > 0).all()) == (terms <= 16)
    hit = trace_rays(lens.system(), rays, losses=losses)
    expected = expected_share(lens, rays, losses)
    assert (hit.transmission - expected)[hit.valid].abs().max() < 1e-12
    totals = (torch.where(hit.valid, s, 0.0).sum() for s in (hit.transmission, expected))
    require_equal_slopes(*totals, inputs_of(lens, rays, losses))


@pytest.mark.parametrize("terms", [8, 20])
def test_rays_of_several_wavelengths_at_once(terms, root):
    """Each ray has the columns of its wavelength, among others of its block or apart from them."""
    lens = LENSES["mirrors"](root)
    lens.backend = "cpu"
    losses, rays = drawn(lens, 3, terms), free(bundle(lens, 150))
    waves = torch.tensor([450.0, 550.0, 650.0], dtype=F64)
    inputs, found = inputs_of(lens, rays, losses), []
    alone = [trace_rays(lens.system(), Rays(rays.position, rays.direction, float(w)),
                        losses=column_of(losses, k)) for k, w in enumerate(waves)]  # fmt: skip
    expected = torch.stack([hit.transmission for hit in alone])
    weights = torch.linspace(-1.0, 1.0, 150, dtype=F64)
    total = (expected * alone[0].valid * weights).sum()
    for mixed in (False, True):
        place = (slice(None), None) if mixed else (None, slice(None))
        given = Rays(
            rays.position[place], rays.direction[place], waves if mixed else waves[:, None]
        )
        share = trace_rays(lens.system(), given, losses=losses).transmission
        share = share.T if mixed else share
        assert (share - expected)[:, alone[0].valid].abs().max() < 1e-13
        found.append((share * alone[0].valid * weights).sum())
    for one in found:
        require_equal_slopes(one, total, inputs)


def column_of(losses, k):
    """The losses of one wavelength."""
    part = {n: getattr(losses, n)[:, k : k + 1] for n in ("coefficients", "ratios", "absorption")}
    return replace(losses, **part)


def test_single_precision_rounds_and_no_more(root):
    lens = LENSES["even_aspheres"](root).float().double()
    rays, losses = bundle(lens, 300, fill=0.9), drawn(lens)
    rays = Rays(rays.position.float().double(), rays.direction.float().double(), 550.0)
    found = []
    for one in (lens, lens.float()):
        system = one.system().traced_by("cpu")
        given = Rays(rays.position.to(one.dtype), rays.direction.to(one.dtype), 550.0)
        hit = trace_rays(system, given, losses=losses)
        total = torch.where(hit.valid, hit.transmission, 0.0).sum()
        own = (losses.coefficients, losses.absorption, *one.parameters())
        slopes = torch.autograd.grad(total, own, allow_unused=True, materialize_grads=True)
        found.append((hit.transmission.detach(), slopes))
    (exact, slopes), (single, rounded) = found
    assert single.dtype == torch.float32
    assert (single - exact).abs().max() < 5e-7
    for one, other in zip(rounded, slopes, strict=True):
        assert (one - other).abs().max() <= 2e-5 * other.abs().max()


def test_an_index_counts_by_cosine_and_distance(root):
    """The derivative with respect to the wavelength, with losses that are the same at all."""
    lens = LENSES["posed"](root)
    lens.backend = "cpu"
    rays, losses = bundle(lens, 40), drawn(lens)

    def total(nm):
        hit = trace_rays(lens.system(), replace(rays, wavelength=nm), losses=losses)
        return torch.where(hit.valid, hit.transmission, 0.0).sum()

    nm = torch.tensor(500.0, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(total(nm), nm)
    difference = (total(nm.detach() + 0.01) - total(nm.detach() - 0.01)) / 0.02
    assert float(slope) == pytest.approx(float(difference.detach()), rel=1e-7)


def test_slopes_by_differences(root):
    """Of a tilt, a curvature, a coefficient and an absorption, without any other code of ours."""
    lens = LENSES["folded"](root)
    lens.backend = "cpu"
    rays, losses = bundle(lens, 50), drawn(lens)
    named = dict(lens.named_parameters())
    inputs = [named["elements.1.tilt_x"], named["surfaces.10.curvature"], named["thicknesses.3"],
              losses.coefficients, losses.absorption, losses.ratios]  # fmt: skip

    def total():
        hit = trace_rays(lens.system(), rays, losses=losses)
        return torch.where(hit.valid, hit.transmission, 0.0).sum()

    slopes = torch.autograd.grad(total(), inputs)
    for value, slope in zip(inputs, slopes, strict=True):
        flat, step = value.detach().reshape(-1), 1e-6
        ends = []
        for sign in (1.0, -2.0):
            flat[3 % len(flat)] += sign * step
            ends.append(float(total().detach()))
        flat[3 % len(flat)] += step
        found = float(slope.reshape(-1)[3 % len(flat)])
        assert found == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-5, abs=1e-8)


def test_the_rays_are_the_same_to_the_bit_and_a_plain_trace_needs_no_other_kernels(
    root, monkeypatch
):
    lens = LENSES["posed"](root)
    lens.backend = "cpu"
    rays = bundle(lens)
    found = trace_rays(lens.system(), rays, losses=drawn(lens))
    monkeypatch.setattr(kernels, "passed_light", None)
    plain = trace_rays(lens.system(), rays)
    assert plain.transmission is None
    for name in ("position", "direction", "path_length", "status", "surface"):
        assert torch.equal(getattr(found, name), getattr(plain, name)), name


COATED = {
    "coating": "quarter_wave",
    "surfaces": {
        "1": {"type": "sphere", "radius": 30.0, "semi_diameter": 8.0, "thickness": 6.0,
              "material": "N-BK7"},
        "2": {"type": "sphere", "radius": -30.0, "semi_diameter": 8.0, "thickness": 2.0,
              "material": "N-SF5"},
        "3": {"type": "conic", "radius": 90.0, "conic": -1.0, "semi_diameter": 8.0,
              "material": "air"},
    },
    "sensor": {"distance": 40.0},
}  # fmt: skip


def test_the_share_follows_a_film_that_changes_in_place():
    """What is kept of a lens's losses goes by the films' numbers, wavelengths and surfaces."""
    lens = lens_from_prescription(COATED)
    rays = bundle(lens, 80)
    film = lens.get_parameter("surfaces.1.coating.thickness_1")
    for backend in ("cpu", "reference"):
        lens.backend = backend
        with torch.no_grad():
            shares = [lens.trace(rays, transmission=True, last=k).transmission for k in (1, 3)]
            film.mul_(2.0)
            shares.append(lens.trace(rays, transmission=True).transmission)
            film.mul_(0.5)
        shares.append(lens.trace(replace(rays, wavelength=450.0), transmission=True).transmission)
        found = torch.stack(shares).nanmean(1).detach()
        if backend == "cpu":
            fast = found
    assert len(set(found.tolist())) == 4
    assert (fast - found).abs().max() < 1e-9


def test_what_is_kept_of_losses_serves_gradients_later():
    """A lens that was judged in inference mode, or within a transform, is trained afterwards."""
    lens = lens_from_prescription(COATED | {"coating": "none"})
    lens.backend = "cpu"
    rays = bundle(lens, 80)

    def passed():
        return lens.trace(rays, transmission=True).transmission.nansum()

    with torch.inference_mode():
        first = passed()
    again = passed()
    again.backward()
    assert lens.surfaces["1"].curvature.grad.abs() > 0.0
    assert torch.func.grad(lambda x: x * passed().detach())(torch.ones((), dtype=F64)) == again
    assert first.item() == again.item()


def test_coatings_and_glasses_as_series_lose_what_they_lose():
    """Values and the derivatives with respect to curvatures and the layers' thicknesses."""
    lens = lens_from_prescription(COATED)
    lens.backend = "cpu"
    waves = torch.tensor([[450.0], [650.0]], dtype=F64)
    rays = bundle(lens, 80, wavelengths=waves.tolist())
    losses = losses_of(lens.system(), waves)
    assert Cosine.LEAVING in losses.cosines and Cosine.ARRIVING in losses.cosines
    fast = trace_rays(lens.system(), rays, losses=losses)
    slow = trace_rays(lens.system().traced_by("reference"), rays, transmission=True)
    valid = slow.valid
    assert slow.transmission[valid].min() > 0.85 and slow.transmission[valid].max() < 1.0
    assert (fast.transmission - slow.transmission)[valid].abs().max() < 1e-9
    totals = (torch.where(valid, hit.transmission, 0.0).sum() for hit in (fast, slow))
    require_equal_slopes(*totals, dict(lens.named_parameters()), relative=1e-8)


@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
def test_a_trace_that_is_asked_for_transmission_takes_series(sense, dtype, bound):
    """Kernels and reference, both ways through a coated lens with a film that has no series of
    few terms.
    """
    layers = [{"material": 1.38, "thickness": 90.0}, {"material": 2.3, "thickness": 900.0}]
    for coating in ("quarter_wave", layers):
        lens = lens_from_prescription(COATED | {"coating": coating}, dtype)
        system = lens.system()
        rays = bundle(lens, 80)
        if sense < 0.0:
            hit = trace_rays(system, rays)
            rays = Rays(hit.position[hit.valid], -hit.direction[hit.valid], rays.wavelength)
        fast, slow = (
            trace_rays(system.traced_by(backend), rays, sense, transmission=True)
            for backend in ("cpu", "reference")
        )
        assert bool(slow.valid.sum() > 20)
        assert (fast.transmission - slow.transmission)[slow.valid].abs().max() < bound


@pytest.mark.parametrize(("dtype", "bound"), [(F64, 2e-12), (torch.float32, 5e-6)])
def test_bare_glass_passes_what_fresnel_says_at_all_angles(dtype, bound):
    """Blocks of rays within and beyond 60°, where the kernels sum other series, and of both."""
    plate = {"type": "plane", "semi_diameter": 1e6}
    surfaces = {
        "1": {**plate, "thickness": 1e-3, "material": "1.5"},
        "2": {**plate, "material": "air"},
    }
    given = {"surfaces": surfaces, "coating": "none", "sensor": {"distance": 1e-3}}
    lens = lens_from_prescription(given, dtype)
    lens.backend = "cpu"
    angle = torch.linspace(0.0, 89.0, 512, dtype=F64)
    angle = torch.cat((angle, angle.view(-1, 2).T.flatten(), angle.flip(0))).to(dtype).double()
    tilt = torch.stack((torch.zeros_like(angle), angle.deg2rad().sin(), angle.deg2rad().cos()), -1)
    hit = lens.trace(Rays(torch.zeros_like(tilt), tilt.to(dtype)), transmission=True)
    front, behind = tilt[:, 2], (1.0 - (tilt[:, 1] / 1.5).square()).sqrt()
    s = 6.0 * front * behind / (front + 1.5 * behind).square()
    p = 6.0 * front * behind / (1.5 * front + behind).square()
    assert (hit.transmission - (0.5 * (s + p)).square()).abs().max() < bound


def test_light_that_glass_reflects_within():
    """A ghost's light meets the last surface from within, where its reflectance has a root."""
    lens = lens_from_prescription(COATED | {"coating": "none"})
    system = with_losses(lens.system())
    (ghost,) = ghost_path_systems(system, [(3, 1)], ClearAperture(Unlimited(1e6)))
    assert len(ghost.mirrors) == 2
    rays = bundle(lens, 200, fill=1.3)
    slow = trace_rays(ghost.traced_by("reference"), rays, transmission=True)
    losses = losses_of(ghost, torch.tensor([550.0], dtype=F64))
    assert Cosine.BEYOND in losses.cosines
    fast = trace_rays(ghost.traced_by("cpu"), rays, losses=losses)
    valid = slow.valid
    assert valid.sum() > 50 and slow.transmission[valid].max() < 0.01
    assert (fast.transmission / slow.transmission - 1.0)[valid].abs().max() < 1e-5


def test_a_series_is_that_of_its_shares():
    shares = torch.rand(2, 9, generator=torch.Generator().manual_seed(0), dtype=F64)
    u = nodes(9, 0.4)
    polynomials = torch.cos(torch.acos(1.0 - 2.0 * (1.0 - u) / 0.6)[:, None] * torch.arange(9))
    assert torch.allclose(series(shares) @ polynomials.T, shares, atol=1e-13)
    assert bool((u.diff() > 0.0).all()) and u[0] > 0.4 and u[-1] < 1.0


def test_the_operator_is_one_of_pytorchs(root):
    """Schema, fake tensors, registration; a batch of gradients; a second derivative says so."""
    lens = LENSES["cooke_triplet"](root)
    lens.backend = "cpu"
    rays, losses = bundle(lens, 40), drawn(lens)
    hit = trace_rays(lens.system(), rays, losses=losses)
    share = torch.where(hit.valid, hit.transmission, 0.0)
    parts = torch.stack((share[:20].sum(), share[20:].sum()))
    (batch,) = torch.autograd.grad(
        parts, losses.coefficients, torch.eye(2, dtype=F64), is_grads_batched=True,
        retain_graph=True,
    )  # fmt: skip
    (whole,) = torch.autograd.grad(parts.sum(), losses.coefficients, create_graph=True)
    assert torch.allclose(batch.sum(0), whole, atol=1e-12)
    with pytest.raises(InputError, match="backend 'reference'"):
        whole.sum().backward()
    seen = []
    original = operators.trace_losses

    def kept(*inputs):
        seen.append(inputs)
        return original(*inputs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(operators, "trace_losses", kept)
        patch.setattr("dolens.optics.ray_tracing.traces_eagerly", lambda *_: False)
        again = trace_rays(lens.system(), rays, losses=losses)
    assert torch.equal(again.transmission, hit.transmission)
    tensors = [v.detach().clone() if isinstance(v, torch.Tensor) else v for v in seen[0]]
    for place in (0, 1, 2, 3, 4):
        tensors[place].requires_grad_()
    torch.library.opcheck(original, tensors, test_utils=("test_schema", "test_faketensor"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"numbers": (1, 2, 3, 4, 5, 7)}, "of a lens of 6"),
        ({"coefficients": torch.ones(6, 2, 8)}, "coefficients .* must begin with .6, 1"),
        ({"absorption": torch.ones(6, 1)}, "absorption .* must begin with .7, 1"),
        ({"cosines": (Cosine.LEAVING,)}, "1 cosines for 6 surfaces"),
        ({"lowest": (1.0,) * 6}, "from 0 to below 1"),
    ],
)
def test_losses_that_do_not_fit(change, message, root):
    lens = LENSES["cooke_triplet"](root)
    lens.backend = "cpu"
    with pytest.raises(InputError, match=message):
        trace_rays(lens.system(), bundle(lens), losses=replace(drawn(lens), **change))


def test_other_backends_take_no_series(root):
    lens = LENSES["cooke_triplet"](root)
    lens.backend = "reference"
    with pytest.raises(InputError, match="not by 'reference'"):
        trace_rays(lens.system(), bundle(lens), losses=drawn(lens))
