"""Traces: error against double precision, and time, by precision and by what traces."""

import copy
import math
from unittest import mock

import torch

from dolens.experiments.speed.renders import Subject, by_turns
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays, TracedRays
from dolens.optics.surfaces import base, newton

_NEWTON_STEPS = (0, 1, 2, 3, 4, 5, 6, 8, 12)
_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def trace_rows(
    subject: Subject, backends: tuple[str, ...], rays: int, seconds: float
) -> list[dict[str, float | str]]:
    """Return a row for each precision and backend: error of sensor points, time a ray and surface.

    Args:
        subject: the lens.
        backends: of `reference`, `cpu`, `cuda`.
        rays: how many.
        seconds: that timing may take.
    """
    lenses = {
        (name, backend): _lens(subject.lens, dtype, backend)
        for name, dtype in _DTYPES.items()
        for backend in backends
    }
    given = {name: _rays(lenses[name, backends[0]], rays) for name in _DTYPES}
    true = lenses["float64", "reference"].trace(given["float64"])
    times = {}
    for backward in (False, True):
        calls = {
            key: lambda lens=lens, key=key, b=backward: _trace(lens, given[key[0]], b)
            for key, lens in lenses.items()
        }
        times[backward] = by_turns(calls, seconds)
    rows = []
    for (name, backend), lens in lenses.items():
        name_of = f"{backend}, {name}"
        spent = times[False][name, backend], times[True][name, backend]
        rows.append(
            _row(subject, backend, name_of, _error(lens.trace(given[name]), true), spent, rays)
        )
    return rows + _newton_rows(lenses["float64", "reference"], given["float64"], subject, seconds)


def _newton_rows(
    lens: Lens, given: Rays, subject: Subject, seconds: float
) -> list[dict[str, float | str]]:
    """Return a row for each number of Newton's steps up to the first that is enough.

    Steps that derivatives take besides are not counted.

    The rule that ends the iteration, √ε of the way, is not a setting of the library; its number of
    steps is held down here to see what the rule buys.
    """
    with mock.patch.object(base, "find_root", wraps=base.find_root) as iteration:
        true = lens.trace(given)
    if not iteration.called:
        # Spheres and conics have closed forms.
        return []
    count = given.position[..., 0].numel()
    rows = []
    for steps in _NEWTON_STEPS:
        with mock.patch.object(newton, "MAX_STEPS", steps):
            error = _error(lens.trace(given), true)
            calls = {b: lambda b=b: _trace(lens, given, b) for b in (False, True)}
            times = by_turns(calls, seconds)
        name = f"{steps} of Newton's steps, float64"
        spent = times[False], times[True]
        rows.append(_row(subject, "Newton's steps", name, error, spent, count))
        if error == 0.0:
            break
    return rows


def _error(hit: TracedRays, true: TracedRays) -> float:
    """Return the largest distance on the sensor along x or y, mm; infinite if no ray arrives."""
    both = hit.valid & true.valid
    moved = (hit.position.detach().double() - true.position.detach())[both].abs()
    return float(moved.max()) if moved.numel() else math.inf


def _row(
    subject: Subject,
    model: str,
    setting: str,
    error: float,
    seconds: tuple[float, float],
    rays: int,
) -> dict[str, float | str]:
    """Return a row for an error in mm, and seconds of all rays forward and with the gradient."""
    forward, with_gradient = (1e9 * s / (rays * len(subject.lens.surfaces)) for s in seconds)
    return {
        "scene": subject.name,
        "part": "trace",
        "model": model,
        "setting": setting,
        "error_um": 1e3 * error,
        "forward_ns": forward,
        "with_gradient_ns": with_gradient,
    }


def _lens(lens: Lens, dtype: torch.dtype, backend: str) -> Lens:
    changed = copy.deepcopy(lens).to(dtype).requires_grad_(True)
    changed.backend = backend
    return changed


@torch.no_grad()
def _rays(lens: Lens, count: int) -> Rays:
    """Return parallel rays, a little off the axis, that fill the entrance pupil."""
    pupil = lens.first_order().entrance_pupil
    generator = torch.Generator().manual_seed(0)
    disc = torch.rand(2, count, generator=generator, dtype=torch.float64) - 0.5
    slope = 0.02
    x, y = disc * float(pupil.diameter) * 0.95
    position = torch.stack((x, y - slope * float(pupil.z), torch.zeros_like(x)), -1)
    direction = torch.tensor([0.0, slope, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(position.shape)
    return Rays(position.to(lens.dtype), direction.to(lens.dtype), lens.primary_wavelength)


def _trace(lens: Lens, rays: Rays, backward: bool) -> None:
    if not backward:
        with torch.no_grad():
            lens.trace(rays)
        return
    hit = lens.trace(rays)
    torch.where(hit.valid[..., None], hit.position, 0.0).square().mean().backward()
    lens.zero_grad()
