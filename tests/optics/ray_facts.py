"""What holds of every ray of every lens, as counts of the rays that break it."""

import copy
from collections import Counter
from collections.abc import Iterator

import torch

from dolens import Lens, Rays
from dolens.optics.jacobian import OUTPUTS, normal_equations, ray_jacobian
from dolens.optics.rays import TracedRays
from tests.optics.random_lenses import random_lens, random_rays, returning

BACKENDS = ("reference", "cpu")
PRECISIONS = (torch.float32, torch.float64)


def cases(seed: int, wild: bool, count: int) -> Iterator[tuple[str, Lens, Rays, float]]:
    """A random lens with rays from either side, and the light that arrived, sent back."""
    lens, draw = random_lens(seed, wild)
    forward = random_rays(lens, draw, count, 1.0)
    yield "forward", lens, forward, 1.0
    yield "backward", lens, random_rays(lens, draw, count, -1.0), -1.0
    back = returning(lens, forward, draw)
    if len(back.position):
        yield "returning", lens, back, -1.0


def send(lens: Lens, rays: Rays, sense: float, backend: str, record: bool = False) -> TracedRays:
    """Trace by one backend."""
    lens.backend = backend
    return (lens.trace if sense > 0.0 else lens.sensor_to_scene)(rays, record)


def held(rays: Rays, dtype: torch.dtype) -> Rays:
    """The same rays in another precision, leaves of a graph."""
    position, direction = (
        v.detach().to(dtype).clone().requires_grad_() for v in (rays.position, rays.direction)
    )
    return Rays(position, direction, rays.wavelength)


def chosen(rays: Rays, which: torch.Tensor) -> Rays:
    """Some of the rays."""
    wavelength = rays.wavelength
    if isinstance(wavelength, torch.Tensor):
        wavelength = wavelength[which]
    return Rays(rays.position[which], rays.direction[which], wavelength)


def undecided(
    lens: Lens,
    rays: Rays,
    sense: float,
    dtype: torch.dtype,
    tries: int = 64,
    roundings: float = 4.0,
) -> torch.Tensor:
    """Which rays have another fate by one and the same backend when the inputs are rounded anew.

    Args:
        lens: in the precision `dtype`.
        rays: (N, 3), whose fates differ between backends.
        sense: +1 or -1.
        dtype: the precision.
        tries: how often every number of the lens and of the rays is moved.
        roundings: by up to so many units in its last place.
    """
    generator = torch.Generator().manual_seed(0)
    epsilon = roundings * torch.finfo(dtype).eps

    def rounded(values: torch.Tensor) -> torch.Tensor:
        noise = 2.0 * torch.rand(values.shape, generator=generator, dtype=torch.float64) - 1.0
        return (values.detach().double() * (1.0 + epsilon * noise)).to(dtype)

    fates = {backend: [] for backend in BACKENDS}
    with torch.no_grad():
        for attempt in range(tries):
            moved, given = copy.deepcopy(lens), held(rays, dtype)
            if attempt:
                for parameter in moved.parameters():
                    parameter.copy_(rounded(parameter))
                given = Rays(rounded(given.position), rounded(given.direction), rays.wavelength)
            for backend in BACKENDS:
                hit = send(moved, given, sense, backend)
                fates[backend].append(4 * hit.surface.long() + hit.status)
    reference, cpu = (torch.stack(fates[backend]) for backend in BACKENDS)
    return ((reference == cpu[0]).any(0)) | ((cpu == reference[0]).any(0))


def _broken(values: torch.Tensor) -> torch.Tensor:
    """Which rays have a number that is not finite."""
    return ~torch.isfinite(values.detach()).reshape(len(values), -1).all(1)


def violations(
    lens: Lens, rays: Rays, sense: float, dtype: torch.dtype, jacobians: tuple[str, ...] = ()
) -> Counter:
    """How many rays break which rule, in one precision; parameters count as rays do.

    Args:
        lens: any.
        rays: (N, 3).
        sense: +1 or -1.
        dtype: the precision to trace in.
        jacobians: backends whose Jacobians are looked at too, of rays from the object.
    """
    found: Counter = Counter()
    lens = copy.deepcopy(lens).to(dtype)
    hits = {}
    for backend in BACKENDS:
        given = held(rays, dtype)
        record = backend == "reference"
        hit = hits[backend] = send(lens, given, sense, backend, record)
        if record:
            bad = _broken(hit.points.movedim(0, 1))
            found["reference: not finite, recorded point"] += int(bad.sum())
        outputs = torch.cat((hit.position, hit.direction, hit.path_length[:, None]), 1)
        bad = _broken(outputs)
        found[f"{backend}: not finite, valid"] += int((bad & hit.valid).sum())
        found[f"{backend}: not finite, invalid"] += int((bad & ~hit.valid).sum())
        weights = torch.linspace(-1.0, 1.0, outputs.numel(), dtype=dtype).reshape(outputs.shape)
        inputs = [given.position, given.direction, *lens.parameters()]
        gradients = torch.autograd.grad((outputs * weights).sum(), inputs, allow_unused=True)
        for gradient in gradients[:2]:
            if gradient is None:
                continue
            bad, passed = _broken(gradient), (gradient != 0.0).any(1)
            found[f"{backend}: gradient not finite, valid"] += int((bad & hit.valid).sum())
            found[f"{backend}: gradient of invalid rays"] += int((passed & ~hit.valid).sum())
        found[f"{backend}: parameter's gradient not finite"] += sum(
            int(g is not None and not torch.isfinite(g).all()) for g in gradients[2:]
        )
        if sense > 0.0 and backend in jacobians:
            found += _jacobian_violations(lens, rays, dtype, backend)
    a, b = hits.values()
    differs = (a.status != b.status) | (a.surface != b.surface)
    if bool(differs.any()):
        excused = undecided(lens, chosen(rays, differs), sense, dtype)
        validity = (a.valid != b.valid)[differs]
        for what, which in (("validity", validity), ("status", ~validity)):
            found[f"{what} differs, within rounding"] += int((which & excused).sum())
            found[f"{what} differs"] += int((which & ~excused).sum())
    return +found


def _jacobian_violations(lens: Lens, rays: Rays, dtype: torch.dtype, backend: str) -> Counter:
    found: Counter = Counter()
    # Few rays: the reference has a column for every coefficient of a spline.
    few = slice(0, 128)
    wavelength = rays.wavelength
    if isinstance(wavelength, torch.Tensor):
        wavelength = wavelength[few]
    some = Rays(rays.position[few].to(dtype), rays.direction[few].to(dtype), wavelength)
    lens.backend = backend
    jacobian = ray_jacobian(lens, some, ["*"], OUTPUTS)
    for values in (jacobian.values, jacobian.derivatives):
        bad = _broken(values)
        found[f"{backend}: Jacobian not finite"] += int(bad.sum())
        moved = (values != 0.0).reshape(len(values), -1).any(1)
        found[f"{backend}: Jacobian of invalid rays"] += int((moved & ~jacobian.valid).sum())
    sums = normal_equations(lens, some, ["*"], outputs=OUTPUTS)
    for total in (sums.sum_of_squares, sums.jtr, sums.jtj):
        found[f"{backend}: normal equations not finite"] += int(not torch.isfinite(total).all())
    return found
