"""Where two backends differ by more than rounding: in values, and in gradients."""

import copy
import math
from collections import Counter
from collections.abc import Iterator

import torch

from dolens import Lens, Rays
from dolens.optics.elements import DISPLACEMENTS, TILTS
from dolens.optics.ray_tracing import from_sensor, trace_rays
from dolens.optics.rays import TracedRays
from tests.optics.random_systems import any_rays, random_system
from tests.optics.ray_facts import BACKENDS, chosen, held, rounded, send, vectors

# Differences that are looked into, in units in the last place of a ray's largest number.
QUICK = {"value": 1e3, "gradient": 1e4}
# Beyond that, a difference is rounding where some of so many traces, each rounded anew, spread
# by a part of it, or where one of them does not arrive: such a ray touches a surface, or is at the
# limit of total reflection, and its gradient there has no bound.
_TRIES, _TIMES = 12, 30.0


def any_cases(seed: int, wild: bool, count: int) -> Iterator[tuple[str, Lens, Rays, float]]:
    """A random system with rays from either side."""
    lens, draw = random_system(seed, wild)
    for way, sense in (("forward", 1.0), ("backward", -1.0)):
        yield way, lens, any_rays(lens, draw, count, sense), sense


def disagreements(lens: Lens, rays: Rays, sense: float, dtype: torch.dtype) -> Counter:
    """How many rays, and parameters, differ between backends beyond what rounding explains."""
    found: Counter = Counter()
    lens = copy.deepcopy(lens).to(dtype)
    traced = []
    for backend in BACKENDS:
        given = held(rays, dtype)
        traced.append((given, send(lens, given, sense, backend)))
    (_, a), (_, b) = traced
    both = a.valid & b.valid
    if not bool(both.any()):
        return found
    which = torch.nonzero(both).squeeze(-1)
    some, outputs, gradients = chosen(rays, which), [], []
    for given, hit in traced:
        outputs.append(_outputs(hit)[which])
        gradients.append(_gradients(lens, given, _outputs(hit), which))
    values = [v.detach().double() for v in outputs]
    size = values[0].abs().amax(1) + rays.position[which].norm(dim=1)
    eps = torch.finfo(dtype).eps
    off = (values[0] - values[1]).abs().amax(1) > QUICK["value"] * eps * size
    of_rays = [g[0].double() for g in gradients]
    largest = of_rays[0].abs().amax(1)
    off_gradient = (of_rays[0] - of_rays[1]).abs().amax(1) > QUICK["gradient"] * eps * largest
    for what, apart, ends in (("value", off, values), ("ray's gradient", off_gradient, of_rays)):
        if bool(apart.any()):
            spread = _spreads(lens, chosen(some, apart), sense, dtype, what)
            differences = (ends[0] - ends[1]).abs().amax(1)[apart]
            excused = differences <= _TIMES * spread
            found[f"{what} differs, within rounding"] += int(excused.sum())
            found[f"{what} differs"] += int((~excused).sum())
    return +(found + _parameters_apart(lens, some, sense, dtype))


def _parameters_apart(lens: Lens, rays: Rays, sense: float, dtype: torch.dtype) -> Counter:
    """How many parameters' derivatives differ, of rays that arrive."""
    found: Counter = Counter()
    gradients = []
    for backend in BACKENDS:
        given = held(rays, dtype)
        outputs = _outputs(send(lens, given, sense, backend))
        gradients.append(_gradients(lens, given, outputs, slice(None)))
    parameters = [g[1].double() for g in gradients]
    scale = gradients[0][2].double()
    off = (parameters[0] - parameters[1]).abs()
    apart = off > QUICK["gradient"] * torch.finfo(dtype).eps * scale
    if bool(apart.any()):
        arrived = _spreads(lens, rays, sense, dtype, "value").isfinite()
        if not bool(arrived.all()):
            # What depends on chance has derivatives without bound, which would hide the others.
            return _parameters_apart(lens, chosen(rays, arrived), sense, dtype)
        spread = _spreads(lens, rays, sense, dtype, "parameters")
        least = _least_roundings(lens, gradients[0][0].double(), rays, dtype)
        excused = (off <= _TIMES * spread.maximum(least))[apart]
        found["parameter's gradient differs, within rounding"] += int(excused.sum())
        found["parameter's gradient differs"] += int((~excused).sum())
    return found


def _outputs(hit: TracedRays) -> torch.Tensor:
    return torch.cat((hit.position, hit.direction, hit.path_length[:, None]), 1)


def _weights(count: int, dtype: torch.dtype) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    return (2.0 * torch.rand((count, 7), generator=generator, dtype=torch.float64) - 1.0).to(dtype)


def _gradients(
    lens: Lens, given: Rays, outputs: torch.Tensor, which: torch.Tensor | slice
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of a random sum of the outputs of some rays: in each ray (K, 6), in all parameters (P,), and
    for each of those the size of the tensor that it belongs to.
    """
    total = (outputs[which] * _weights(len(outputs[which]), outputs.dtype)).sum()
    parameters = list(lens.parameters())
    inputs = [given.position, given.direction, *parameters]
    found = torch.autograd.grad(total, inputs, allow_unused=True)
    found = [torch.zeros_like(i) if g is None else g for i, g in zip(inputs, found, strict=True)]
    sizes = [torch.full_like(g, float(g.abs().max()) if g.numel() else 0.0) for g in found[2:]]
    flat = [torch.cat([g.reshape(-1) for g in each]) for each in (found[2:], sizes)]
    # Directions are unit vectors: nothing is said of the derivative along them.
    unit, along = given.direction.detach(), found[1]
    along = along - (along * unit).sum(1, keepdim=True) * unit
    return torch.cat((found[0], along), 1)[which], flat[0], flat[1]


def _least_roundings(
    lens: Lens, of_rays: torch.Tensor, rays: Rays, dtype: torch.dtype
) -> torch.Tensor:
    """Of each parameter: how little of it rounding leaves, at the least.

    What a surface without power does to rays does not depend on its place: the derivative is a
    difference of equal cotangents, in front of it and behind, and all that is left is rounding.
    """
    pull = float(of_rays[:, :3].norm(dim=1).sum())
    turn = float(of_rays[:, 3:].norm(dim=1).sum()) + pull * float(rays.position.abs().max())
    numbers = torch.finfo(dtype)
    least = []
    for name, parameter in lens.named_parameters():
        key = name.rpartition(".")[2]
        of_pose = turn if key in TILTS else pull if key in DISPLACEMENTS else 0.0
        least.append(torch.full((parameter.numel(),), numbers.eps * of_pose + numbers.tiny))
    return torch.cat(least).double()


def _spreads(lens: Lens, rays: Rays, sense: float, dtype: torch.dtype, what: str) -> torch.Tensor:
    """How far apart results come when all numbers are rounded anew: of each ray, or parameter.

    It is infinite for a ray that then does not arrive in all of the tries.
    """
    generator = torch.Generator().manual_seed(0)
    ends, arrived = [], torch.ones(len(rays.position), dtype=torch.bool)
    for _ in range(_TRIES):
        moved = copy.deepcopy(lens)
        with torch.no_grad():
            for parameter in moved.parameters():
                parameter.copy_(rounded(parameter, dtype, generator))
        given = held(rays, dtype)
        position, direction = (vectors(v, dtype, generator) for v in _numbers(given))
        start = Rays(position.requires_grad_(), direction.requires_grad_(), rays.wavelength)
        outputs, arrives = _rounded_outputs(moved, start, sense, dtype, generator)
        arrived = arrived & arrives
        if what == "value":
            ends.append(outputs.detach().double())
        else:
            of_rays, of_parameters, _ = _gradients(moved, start, outputs, slice(None))
            ends.append((of_parameters if what == "parameters" else of_rays).double())
    ends = torch.stack(ends)
    spread = torch.where(ends.isfinite(), ends, 0.0)
    spread = spread.amax(0) - spread.amin(0)
    return spread if what == "parameters" else spread.amax(1).where(arrived, math.inf)


def _numbers(rays: Rays) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and directions without a graph."""
    return rays.position.detach(), rays.direction.detach()


def _rounded_outputs(
    lens: Lens, rays: Rays, sense: float, dtype: torch.dtype, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """As `_outputs`, with rays rounded anew between one surface and the next; which arrive."""
    system = lens.system().traced_by("reference")
    count, path, arrives = len(system.surfaces), 0.0, True
    rays = rays if sense > 0.0 else from_sensor(system, rays)
    for number in range(1, count + 1) if sense > 0.0 else range(count, 0, -1):
        last = None if sense > 0.0 and number == count else number
        hit = trace_rays(system, rays, sense, False, number, last)
        path, arrives = path + hit.path_length, arrives & hit.valid
        noise = [vectors(v.detach(), dtype, generator) - v.detach()
                 for v in (hit.position, hit.direction)]  # fmt: skip
        rays = Rays(hit.position + noise[0], hit.direction + noise[1], rays.wavelength)
    return torch.cat((rays.position, rays.direction, path[:, None]), 1), arrives
