"""What dolens makes of a hard case, against 80 digits."""

from dataclasses import dataclass
from functools import cache

import torch

from dolens import Rays
from dolens.prescriptions import lens_from_prescription
from tests.optics import exact

WAVELENGTH = 587.5618
# One number that gradients are taken of: x + y/2 on the sensor.
WEIGHTS = (1.0, 0.5)
TINY = exact.mp.mpf(10) ** -30


@dataclass(frozen=True)
class Errors:
    """Largest over a case's rays.

    Attributes:
        value: of a sensor coordinate, mm.
        gradient: of a derivative, relative to it (to the largest one where it is zero by symmetry).
        value_roundings: the same in units of what one rounding of the inputs does.
        gradient_roundings: likewise.
    """

    value: float
    gradient: float
    value_roundings: float
    gradient_roundings: float


def measure(case, dtype, backend="auto"):
    """Trace the rays of a case, and compare values and gradients of all parameters."""
    lens = lens_from_prescription(case.prescription(), dtype, backend=backend)
    rows = [
        _one_ray(lens, _exactly(case, i, dtype), *ray, dtype) for i, ray in enumerate(case.rays)
    ]
    return Errors(*(max(column) for column in zip(*rows, strict=True)))


def traced(lens, origin, direction, dtype):
    """The ray as the precision holds it, and its trace."""
    origin, direction = (
        torch.tensor(v, dtype=torch.float64).to(dtype) for v in (origin, direction)
    )
    return origin, direction, lens.trace(Rays(origin, direction, WAVELENGTH))


@dataclass(frozen=True)
class Exact:
    """A ray in 80 digits, and what one rounding of the inputs does to each number."""

    point: list
    moves: list
    slopes: list
    slope_moves: list


@cache
def _exactly(case, number, dtype):
    """The ray of that number, through the lens as the precision holds both."""
    lens = lens_from_prescription(case.prescription(), dtype)
    stored = exact.values_of(lens)
    origin, direction = (
        torch.tensor(v, dtype=torch.float64).to(dtype).tolist() for v in case.rays[number]
    )
    axes = ("o0", "o1", "o2", "d0", "d1", "d2")
    numbers = [exact.mp.mpf(v) for v in (*origin, *direction)]
    inputs = stored | dict(zip(axes, numbers, strict=True))

    def through(values, near=None):
        ray = [values[name] for name in axes]
        parameters = {n: v for n, v in values.items() if n not in axes}
        status, _, p, _, distances = exact.trace(
            lens, parameters, ray[:3], ray[3:], WAVELENGTH, near
        )
        assert status == exact.OK, "the case must pass"
        return list(p), distances

    base, distances = through(inputs)

    def point(values):
        return through(values, distances)[0]

    def weighted(values):
        p = point(values)
        return WEIGHTS[0] * p[0] + WEIGHTS[1] * p[1]

    def gradients(values):
        fixed = {n: v for n, v in values.items() if n in axes}
        parameters = {n: v for n, v in values.items() if n not in axes}
        found = exact.derivatives(lambda some: weighted(some | fixed), parameters)
        return [found[name] for name in stored]

    slopes = gradients(inputs)
    return Exact(
        base[:2],
        exact.sensitivity(lambda v: point(v)[:2], inputs, base[:2]),
        slopes,
        exact.sensitivity(gradients, inputs, slopes, draws=2),
    )


def _one_ray(lens, expected, origin, direction, dtype):
    *_, hit = traced(lens, origin, direction, dtype)
    assert bool(hit.valid), "the ray must pass"
    epsilon = torch.finfo(dtype).eps
    points = zip(hit.position.tolist()[:2], expected.point, strict=True)
    errors = [abs(v - e) for v, e in points]
    total = WEIGHTS[0] * hit.position[0] + WEIGHTS[1] * hit.position[1]
    parameters = list(lens.parameters())
    gradient_of = torch.autograd.grad(total, parameters, allow_unused=True)
    found = [
        number
        for p, g in zip(parameters, gradient_of, strict=True)
        for number in (torch.zeros_like(p) if g is None else g).flatten().tolist()
    ]
    largest = max(abs(s) for s in expected.slopes)
    relative, roundings = [], []
    for gradient, slope, move in zip(found, expected.slopes, expected.slope_moves, strict=True):
        error = abs(gradient - slope)
        if abs(slope) <= TINY * largest:
            # Zero by symmetry: what is left is rounding of terms as large as the other slopes.
            slope = move = largest or 1
        relative.append(float(error / abs(slope)))
        roundings.append(float(error / (epsilon * move)))
    moved = zip(errors, expected.moves, strict=True)
    return (
        float(max(errors)),
        max(relative),
        float(max(e / (epsilon * max(m, TINY)) for e, m in moved)),
        max(roundings),
    )
