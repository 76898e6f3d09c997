"""Rays move through gradient-index media.

Along a ray let dt = ds/n, s being its length.  Position r and optical direction T = dr/dt, whose
length is n, then follow (Sharma, Kumar and Ghatak, Appl. Opt. 21, 984 (1982))

    dr/dt = T,   dT/dt = ½·∇n²(r),   dP/dt = ½·T² + ½·n²(r)

with P the optical path ∫n·ds.  The two halves, T at rest and r at rest, are each solved exactly,
and a symplectic splitting of order six joins them (Blanes and Moan, J. Comput. Appl. Math. 142, 313
(2002), SRKN 11).  P is the action of this motion, and has the same order.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from dolens.kernels.table import DRIFTS, KICKS
from dolens.optics.autograd import is_transformed
from dolens.optics.gradients import Bend, Number, Profile

# So many rays are traced once more for their derivatives, whose memory is then that of a step.
_MANY = 4096
# Steps per radian of phase, of which a parabolic profile has 2π a pitch, and the fewest: they err
# by 1e-12 in double precision.
_STEPS = {torch.float64: (8.0, 6), torch.float32: (2.0, 2)}
_MOST_STEPS = 4096
# Points along and across a gap at which its profile is looked at.
_LOOKS = 17


class Motion(NamedTuple):
    """A ray in motion: position (mm), optical direction T, optical path (mm)."""

    x: Number
    y: Number
    z: Number
    tx: Number
    ty: Number
    tz: Number
    path: Number


def carry(
    bend: Callable[[Number, Number, Number], Bend], start: Motion, t: Number, steps: int
) -> Motion:
    """Carry rays on by t = ∫ds/n (mm), in so many steps.

    Args:
        bend: n² and its half gradient at x, y, z.
        start: tensors or numbers of one shape.
        t: of each ray.
        steps: one or more.
    """
    h = t / steps
    motion = _kicked(bend, start, KICKS[0] * h)

    def step(motion: Motion, last: float) -> Motion:
        for drift, kick in zip(DRIFTS, (*KICKS[1:-1], last), strict=True):
            motion = _kicked(bend, _drifted(motion, drift * h), kick * h)
        return motion

    replays = (
        torch.is_grad_enabled()
        and isinstance(motion.x, Tensor)
        and motion.x.numel() >= _MANY
        and not is_transformed()
    )
    for k in range(steps):
        # The last kick of a step and the first of the next are one.
        last = (2.0 if k + 1 < steps else 1.0) * KICKS[0]
        if replays:
            motion = checkpoint(step, motion, last, use_reentrant=False, preserve_rng_state=False)
        else:
            motion = step(motion, last)
    return motion


def _kicked(bend: Callable[[Number, Number, Number], Bend], motion: Motion, k: Number) -> Motion:
    x, y, z, tx, ty, tz, path = motion
    squared, fx, fy, fz = bend(x, y, z)
    return Motion(x, y, z, tx + k * fx, ty + k * fy, tz + k * fz, path + 0.5 * k * squared)


def _drifted(motion: Motion, d: Number) -> Motion:
    x, y, z, tx, ty, tz, path = motion
    path = path + 0.5 * d * (tx * tx + ty * ty + tz * tz)
    return Motion(x + d * tx, y + d * ty, z + d * tz, tx, ty, tz, path)


def steps_through(
    profile: Profile, base: float, start: float, length: float, radius: float, dtype: torch.dtype
) -> int:
    """Return the steps of a ray through a gap.

    Args:
        profile: of the gap.
        base: index of its homogeneous medium.
        start: z of the gap's beginning, from the vertex that the profile counts from, mm.
        length: along the axis, with its sign, mm.
        radius: of what light passes, mm.
        dtype: precision of the rays.

    The fastest change of direction per t over a grid of points, √|∂(½∇n²)/∂r|, times t along the
    axis is the phase.  Two digits of all numbers count.
    """
    lengths = (_two_digits(number) for number in (base, start, length, radius))
    values = tuple(_two_digits(largest(value)) for value in profile.values)
    return _steps((profile.terms, values, profile.squared), *lengths, dtype)


def _two_digits(number: float) -> float:
    return float(f"{number:.2g}")


@lru_cache(maxsize=1024)
def _steps(
    profile: tuple[tuple[str, ...], tuple[float, ...], bool],
    base: float,
    start: float,
    length: float,
    radius: float,
    dtype: torch.dtype,
) -> int:
    bend = Profile(*profile).bend
    share = torch.linspace(0.0, 1.0, _LOOKS, dtype=torch.float64)
    z, r = start + length * share[:, None, None], radius * share[:, None]
    x, y = (
        r * torch.tensor(sign).double() for sign in ((1.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, -1.0))
    )
    step = 1e-4 * max(radius, abs(length), 1e-6)
    zero = torch.zeros(_LOOKS, _LOOKS, 4, dtype=torch.float64)
    here = [zero + part for part in bend(base, x, y, z)]
    fastest = 0.0
    for dx, dy, dz in ((step, 0.0, 0.0), (0.0, step, 0.0), (0.0, 0.0, step)):
        there = bend(base, x + dx, y + dy, z + dz)
        change = sum((a - b) ** 2 for a, b in zip(there[1:], here[1:], strict=True)).sqrt()
        fastest = max(fastest, float(change.max()) / step)
    slowest = max(float(here[0][:, 0].min()), 0.0)
    phase = math.sqrt(fastest) * (abs(length) + 0.5 * radius) / max(math.sqrt(slowest), 0.3)
    rate, least = _STEPS.get(dtype, _STEPS[torch.float64])
    if not math.isfinite(phase):
        return _MOST_STEPS
    return max(least, min(_MOST_STEPS, math.ceil(rate * phase)))


def plain(value: Number) -> float:
    """Return a number without a graph, of several the mean, as it is beneath transforms."""
    return float(value) if not isinstance(value, Tensor) else _beneath(value).mean().item()


def largest(value: Number) -> float:
    """Return a number likewise, of several the one that is farthest from zero."""
    if not isinstance(value, Tensor):
        return float(value)
    several = _beneath(value).reshape(-1)
    return several[several.abs().argmax()].item()


def _beneath(value: Tensor) -> Tensor:
    return torch.func.debug_unwrap(value.detach(), recurse=True).double()
