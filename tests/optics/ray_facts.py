"""What holds of every ray of every lens, as counts of the rays that break it."""

import copy
from collections import Counter
from collections.abc import Callable, Iterator

import torch

from dolens import Lens, Rays
from dolens.optics.jacobian import OUTPUTS, normal_equations, ray_jacobian
from dolens.optics.ray_tracing import from_sensor, trace_rays
from dolens.optics.rays import Status, TracedRays
from tests.optics.random_lenses import KINDS, random_lens, random_rays, returning

BACKENDS = ("reference", "cpu")
PRECISIONS = (torch.float32, torch.float64)


def cases(
    seed: int, wild: bool, count: int, kinds: tuple[str, ...] = KINDS
) -> Iterator[tuple[str, Lens, Rays, float]]:
    """A random lens with rays from either side, and the light that arrived, sent back."""
    lens, draw = random_lens(seed, wild, kinds)
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


def rounded(
    values: torch.Tensor, dtype: torch.dtype, generator: torch.Generator, roundings: float = 4.0
) -> torch.Tensor:
    """Numbers moved by up to so many units in their last place."""
    exact = values.detach().double()
    return (exact * (1.0 + _noise(exact, dtype, generator, roundings))).to(dtype)


def vectors(
    values: torch.Tensor, dtype: torch.dtype, generator: torch.Generator, roundings: float = 4.0
) -> torch.Tensor:
    """Vectors (..., 3) moved by up to so many units in the last place of their lengths."""
    exact = values.detach().double()
    length = exact.norm(dim=-1, keepdim=True)
    return (exact + _noise(exact, dtype, generator, roundings) * length).to(dtype)


def _noise(
    like: torch.Tensor, dtype: torch.dtype, generator: torch.Generator, roundings: float
) -> torch.Tensor:
    drawn = torch.rand(like.shape, generator=generator, dtype=torch.float64)
    return roundings * torch.finfo(dtype).eps * (2.0 * drawn - 1.0)


def undecided(
    lens: Lens,
    rays: Rays,
    sense: float,
    dtype: torch.dtype,
    tries: int = 64,
    roundings: float = 4.0,
) -> torch.Tensor:
    """Which rays have another fate by one and the same backend when its numbers are rounded anew:
    those of the lens and of the rays, and the rays between one surface and the next.

    Args:
        lens: in the precision `dtype`.
        rays: (N, 3), whose fates differ between backends.
        sense: +1 or -1.
        dtype: the precision.
        tries: how often every number is moved.
        roundings: by up to so many units in its last place; points and directions by as many of
            their lengths.
    """
    generator = torch.Generator().manual_seed(0)

    def moved_vectors(values: torch.Tensor) -> torch.Tensor:
        return vectors(values, dtype, generator, roundings)

    fates = {backend: [] for backend in BACKENDS}
    with torch.no_grad():
        for attempt in range(tries):
            moved, given = copy.deepcopy(lens), held(rays, dtype)
            between = None
            if attempt:
                for parameter in moved.parameters():
                    parameter.copy_(rounded(parameter, dtype, generator, roundings))
                numbers = (moved_vectors(v) for v in (given.position, given.direction))
                given, between = Rays(*numbers, rays.wavelength), moved_vectors
            for backend in BACKENDS:
                fates[backend].append(_fate(moved, given, sense, backend, between))
    reference, cpu = (torch.stack(fates[backend]) for backend in BACKENDS)
    return ((reference == cpu[0]).any(0)) | ((cpu == reference[0]).any(0))


def _fate(
    lens: Lens,
    rays: Rays,
    sense: float,
    backend: str,
    between: Callable[[torch.Tensor], torch.Tensor] | None,
) -> torch.Tensor:
    """4·surface + status of each ray, (N,); `between` moves points and directions behind each
    surface.
    """
    if between is None:
        hit = send(lens, rays, sense, backend)
        return 4 * hit.surface.long() + hit.status
    system, ended, vignetted = lens.system().traced_by(backend), None, None
    count = len(system.surfaces)
    rays = rays if sense > 0.0 else from_sensor(system, rays)
    for number in range(1, count + 1) if sense > 0.0 else range(count, 0, -1):
        # The sensor's plane belongs to the last surface's step.
        last = None if sense > 0.0 and number == count else number
        hit = trace_rays(system, rays, sense, False, number, last)
        fate = 4 * hit.surface.long() + hit.status
        edge = hit.status == Status.VIGNETTED
        stops, dims = torch.where(edge, 0, fate), torch.where(edge, fate, 0)
        stops = torch.where(hit.valid, 0, stops)
        # A miss or a total reflection ends a ray; an edge in front of it is passed over.
        ended = stops if ended is None else torch.where(ended > 0, ended, stops)
        vignetted = dims if vignetted is None else torch.where(vignetted > 0, vignetted, dims)
        rays = Rays(between(hit.position), between(hit.direction), rays.wavelength)
    return torch.where(ended > 0, ended, vignetted)


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
