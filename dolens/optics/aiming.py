"""Rays of a field are launched towards the lens, and aimed at points of the stop.

Rays of a field are launched from the plane that faces it.

This plane runs through the first vertex, perpendicular to the line from the object point to that
vertex.  It faces a wide field as squarely as a narrow one, however far the entrance pupil wanders,
and for an object at infinity it is a wavefront.

A ray of a given field is fixed by where it crosses the plane that faces the field
(`dolens.optics.aiming`).  Aiming asks for the point q of that plane whose ray meets the stop at
p·R, with p the relative stop coordinates and R the stop's semi-diameter: F(q) = 0, two equations.

It follows the solution along a homotopy: at t the field angle is t times the one asked for, and so
is the point on the stop.  At t = 0 the axis is the solution, or nearly.  Each step is predicted
along the tangent, dq/dt = -J⁻¹ ∂F/∂t with J = ∂F/∂q, both swept back through the trace, and
corrected by Newton's iteration.  Corrections that do not halve F, or that lose the ray, send it
back to the last solution with a quarter of the step: this is what damps Newton's iteration, and
what keeps it on the branch that starts at the axis.  Behind coordinate breaks the axis of object
space need not lead to the stop: there the branch starts at a ray sent back from the stop.  All of
it runs outside the autograd graph; one more Newton step inside leaves the value where it is and has
the implicit function's derivative.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.optics.autograd import is_transformed
from dolens.optics.elements import from_lens_axes, to_lens_axes
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import Trace, stop_gradient_where_invalid, trace_surfaces


def field_line(
    field: Tensor, object_distance: float | Tensor | None = None
) -> tuple[Tensor, float | Tensor]:
    """Return the direction of the line from the object point to the first vertex.

    At infinity it is (tan x, tan y, 1) normalised, written without a tangent: (sin x·cos y,
    cos x·sin y, cos x·cos y) goes on through 90° to light that comes from behind the first vertex.

    Args:
        field: (..., 2), angles in radians for an object at infinity; else the object point's x and
            y in mm.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.

    Returns:
        The unit vectors (..., 3), and 1/object_distance (1/mm).
    """
    near = vergence(object_distance)
    if not isinstance(near, Tensor):
        return (_line_of_angles(field) if near == 0.0 else line_of_slopes(-field * near)), near
    near = near.to(field)
    far = near[..., None] == 0.0
    # Of a finite object the angles, of an infinite one the slopes, are never used.
    angles, slopes = torch.where(far, field, 0.0), torch.where(far, 0.0, -field * near[..., None])
    return torch.where(far, _line_of_angles(angles), line_of_slopes(slopes)), near


def _line_of_angles(angles: Tensor) -> Tensor:
    """Return unit vectors (..., 3) of field angles (..., 2), rad."""
    (sx, sy), (cx, cy) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    line = torch.stack((sx * cy, cx * sy, cx * cy), -1)
    return line / line.norm(dim=-1, keepdim=True)


def line_of_slopes(slopes: Tensor) -> Tensor:
    """Return unit vectors (..., 3) along (slope x, slope y, 1), of slopes (..., 2)."""
    line = torch.cat((slopes, torch.ones_like(slopes[..., :1])), -1)
    return line / line.norm(dim=-1, keepdim=True)


def launch(line: Tensor, near: float | Tensor, q: Tensor) -> Components:
    """Rays of a field through points of the plane that faces it.

    Args:
        line: (..., 3), unit vector of the line from the object point to the first vertex.
        near: 1/object distance, 1/mm; 0 for an object at infinity.
        q: (..., 2), mm, in the plane through the first vertex perpendicular to that line; its axes
            are the lens's x and y, turned with z the shortest way into the line.
    """
    (l, m, n), (qx, qy) = line.unbind(-1), q.unbind(-1)  # noqa: E741
    along = (l * qx + m * qy) / (1.0 + n)
    x, y, z = qx - l * along, qy - m * along, -(l * qx + m * qy)
    # The object point lies a distance n·near before the plane, so far ones lose no digits.
    w = n * near
    inverse = torch.rsqrt(1.0 + w * w * (qx * qx + qy * qy))
    direction = ((l + w * x) * inverse, (m + w * y) * inverse, (n + w * z) * inverse)
    return Components(*torch.broadcast_tensors(x, y, z, *direction))


def polar_angles(line: Tensor) -> tuple[Tensor, Tensor]:
    """Return angles (...) of lines to the axis, rad, and unit vectors (..., 2) of their azimuths;
    zero along the axis.
    """
    across, along = line[..., :2], line[..., 2]
    sine = across.norm(dim=-1)
    return torch.atan2(sine, along), across / sine.clamp(min=torch.finfo(line.dtype).tiny)[
        ..., None
    ]


# Largest turn of the field in one step, rad, and the smallest part of the way that is still tried.
MAX_TURN = 0.4
MIN_STEP = 1e-3
MAX_EVALUATIONS = 150
# Newton's corrections of a guess.
MAX_CORRECTIONS = 8
# How near to its point on the stop, in semi-diameters, a ray on the way must come.
NEAR = 1e-2
# Residual of an aimed ray, in units of rounding at the stop or, seen from there, at the front.
ROUNDING = 512.0


@dataclass(frozen=True, kw_only=True)
class AimedRays(Rays):
    """Rays that cross the stop where they were asked to.

    They start on the plane through the first vertex perpendicular to the line from the object point
    to that vertex: a wavefront of an object at infinity.  From a finite object point, n times the
    distance to it is to be added to path lengths.

    Attributes:
        converged: (...), bool: the ray reaches the stop through the surfaces before it, and meets
            it at the point asked for.  Apertures are not tested.  A ray that is not converged
            starts at the first vertex towards -z, so that a trace finds it MISSED at surface 1, and
            carries no gradient.
        crossing: (..., 2), mm: q, where the ray crosses that plane; a guess for another `aim`.
    """

    converged: Tensor
    crossing: Tensor


def aim(
    system: OpticalSystem,
    field: Tensor,
    pupil: Tensor,
    wavelength: float | Tensor,
    object_distance: float | Tensor | None = None,
    guess: Tensor | None = None,
) -> AimedRays:
    """Rays of a field that cross the stop surface at given points.

    Args:
        system: the lens.
        field: (..., 2): angles (x, y) in radians for an object at infinity, whose rays have
            direction (tan x, tan y, 1) normalised, see `field_line`; else the object point's x
            and y in mm.
        pupil: (..., 2), where the rays cross the stop surface, x and y in its own axes over its
            semi-diameter; in the unit disc.
        wavelength: nm, a number or (...).
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
        guess: `crossing` of the same rays through a lens that is nearly this one, from where a few
            of Newton's corrections lead to the solution; where one does not, all rays are searched
            from the axis as without a guess.

    Returns:
        Rays of the common leading shape.  They have the gradient of the solution with respect to
        the lens, the field and the pupil point, in forward and in reverse mode; the search ends
        when every ray has ended, so that it cannot be mapped over lenses by `vmap`.
    """
    line, near = field_line(field, object_distance)
    target = pupil * system.surfaces[system.stop - 1].semi_diameter
    # Not torch.broadcast_shapes, whose first call imports SymPy: half a second.
    like = torch.broadcast_tensors(line[..., 0], target[..., 0])[0]
    if isinstance(wavelength, Tensor):
        like = torch.broadcast_tensors(like, wavelength)[0]
    line, target = line.expand(*like.shape, 3), target.expand(*like.shape, 2)
    problem = _Problem(system, wavelength, near, line.detach(), target.detach())
    with torch.no_grad():
        found_near = None if guess is None else _corrected(problem, guess.expand(target.shape))
        q, slopes, found = found_near or _follow(problem)
    residual, reached = _miss(system, wavelength, near, line, target, q)
    with torch.no_grad():
        first = system.surfaces[system.met[0] - 1]
        front = slopes.abs().amax((-2, -1)) * first.semi_diameter
        rounding = torch.finfo(system.dtype).eps * (front + problem.scale)
        converged = found & reached & (residual.abs().amax(-1) <= ROUNDING * rounding)
    q = q - _solve(slopes, residual)
    ray = launch(line, near, q)
    position, direction = torch.stack(ray[:3], -1), torch.stack(ray[3:], -1)
    kept = converged[..., None]
    backwards = direction.new_tensor((0.0, 0.0, -1.0))
    return AimedRays(
        stop_gradient_where_invalid(torch.where(kept, position, 0.0 * position.detach()), kept),
        torch.where(kept, direction, backwards),
        wavelength,
        converged=converged,
        crossing=q.detach(),
    )


class _Problem(NamedTuple):
    """The constants of the homotopy."""

    system: OpticalSystem
    wavelength: float | Tensor
    near: float | Tensor
    line: Tensor
    target: Tensor

    @property
    def scale(self) -> float:
        return self.system.surfaces[self.system.stop - 1].semi_diameter


class _Evaluation(NamedTuple):
    """F (..., 2), ∂F/∂q (..., 2, 2), ∂F/∂t (..., 2), and whether the ray reaches the stop."""

    residual: Tensor
    slopes: Tensor
    rate: Tensor
    reached: Tensor


def _corrected(problem: _Problem, q: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
    """Correct a point near the solution, as `_follow` does; None where a ray is not that near."""
    t = torch.ones_like(q[..., 0])
    settled = math.sqrt(torch.finfo(t.dtype).eps)
    allowed = torch.full_like(t, NEAR)
    for _ in range(MAX_CORRECTIONS):
        here = _evaluate(problem, q, t)
        size = here.residual.norm(dim=-1) / problem.scale
        q = q - _solve(here.slopes, here.residual)
        if not bool((here.reached & (size <= allowed) & torch.isfinite(q).all(-1)).all()):
            return None
        if bool((size <= settled).all()):
            return q, here.slopes, torch.ones_like(t, dtype=torch.bool)
        allowed = torch.maximum(0.5 * size, torch.full_like(size, settled))
    return None


def _follow(problem: _Problem) -> tuple[Tensor, Tensor, Tensor]:
    """Follow q from the axis to the field and pupil points asked for, every ray at its own pace.

    Returns:
        q and ∂F/∂q there, and whether the last correction was so small that the next is below
        rounding.  q is zero and ∂F/∂q the identity where it was not.
    """
    q = torch.zeros_like(problem.target) + _start(problem)
    t = torch.zeros_like(q[..., 0])
    angle, _ = polar_angles(problem.line)
    longest = (MAX_TURN / angle.clamp(min=MAX_TURN)).clamp(max=1.0)
    step, start, start_t, rate = longest, q, t, torch.zeros_like(q)
    # Newton's corrections must halve F; the first F after a prediction, within the stop.
    allowed = torch.full_like(t, math.inf)
    settled = math.sqrt(torch.finfo(t.dtype).eps)
    done, failed = torch.zeros_like(t, dtype=torch.bool), torch.zeros_like(t, dtype=torch.bool)
    for _ in range(MAX_EVALUATIONS):
        here = _evaluate(problem, q, t)
        size = here.residual.norm(dim=-1) / problem.scale
        corrected = q - _solve(here.slopes, here.residual)
        good = here.reached & (size <= allowed) & torch.isfinite(corrected).all(-1)
        active = ~(done | failed)
        there = t >= 1.0
        arrived = active & good & there & (size <= settled)
        onward = active & good & ~there & (size <= NEAR)
        back = active & ~good

        start = torch.where(onward[..., None], corrected, start)
        start_t = torch.where(onward, t, start_t)
        rate = torch.where(onward[..., None], -_solve(here.slopes, here.rate), rate)
        step = torch.where(onward, torch.minimum(2.0 * step, longest), step)
        step = torch.where(back, 0.25 * step, step)
        failed = failed | (back & ((step < MIN_STEP * longest) | (start_t == t)))
        done = done | arrived

        next_t = torch.clamp(start_t + step, max=1.0)
        predicted = start + (next_t - start_t)[..., None] * rate
        jump = onward | back
        q = torch.where(
            jump[..., None], predicted, torch.where((active & good)[..., None], corrected, q)
        )
        t = torch.where(jump, next_t, t)
        allowed = torch.where(jump, torch.ones_like(t), torch.where(active, 0.5 * size, allowed))
        if bool((done | failed).all()):
            break
    q = torch.where(done[..., None], q, 0.0)
    slopes = _evaluate(problem, q, torch.ones_like(t)).slopes
    return q, torch.where(done[..., None, None], slopes, torch.eye(2).to(slopes)), done


def _start(problem: _Problem) -> Tensor:
    """Return q (2,), mm, of a ray near the one along the axis of object space through the stop's
    centre.

    That is the axis itself, unless coordinate breaks lead the light elsewhere: then a ray that is
    sent back from the stop's vertex, along its axis, says where the beam comes in.
    """
    system = problem.system
    zero = problem.target.new_zeros(())
    origin = torch.stack((zero, zero))
    if not system.breaks or system.stop == system.met[0]:
        return origin
    number, sense = system.stop, system.senses[system.stop - 1]
    wavelength = problem.wavelength
    if isinstance(wavelength, Tensor):
        wavelength = wavelength.flatten()[0]
    at_stop = Components(zero, zero, zero, zero, zero, zero - sense)
    ray = to_lens_axes(at_stop, system.axes[number - 1])
    traced = trace_surfaces(system, ray, wavelength, -1.0, last=number - 1)
    x, y, z, l, m, n = traced.ray  # noqa: E741
    if not (bool(_reaches(traced)) and float(n) < 0.0):
        return origin
    return torch.stack((x - z / n * l, y - z / n * m))


def _evaluate(problem: _Problem, q: Tensor, t: Tensor) -> _Evaluation:
    """F and its derivatives: a trace of two copies of the rays, swept back once, x and y apart."""
    system, wavelength, near, line, target = problem
    angle, azimuth = polar_angles(line)

    def miss(q: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        part = (t * angle)[..., None]
        turned = torch.cat((part.sin() * azimuth, part.cos()), -1)
        return _miss(system, wavelength, near, turned, t[..., None] * target, q)

    copies = (q.expand(2, *q.shape).contiguous(), t.expand(2, *t.shape).contiguous())
    # Of the first copy the x is derived, of the second the y.
    component = torch.eye(2, dtype=q.dtype, device=q.device).reshape(2, *(1,) * t.ndim, 2)
    if torch.is_inference_mode_enabled() or is_transformed():
        found: Any = torch.func.vjp(miss, *copies, has_aux=True)
        residual, pull_back, reached = found
        of_q, of_t = pull_back(component.expand(residual.shape))
    else:  # torch.func.vjp loads PyTorch's compiler, and a cotangent SymPy: seconds
        with torch.enable_grad():
            copies = (copies[0].detach().requires_grad_(), copies[1].detach().requires_grad_())
            residual, reached = miss(*copies)
            of_q, of_t = torch.autograd.grad((component * residual).sum(), copies)
    return _Evaluation(
        residual[0].detach(),
        torch.stack((of_q[0], of_q[1]), -2).detach(),
        torch.stack((of_t[0], of_t[1]), -1).detach(),
        reached[0],
    )


def _miss(
    system: OpticalSystem,
    wavelength: float | Tensor,
    near: float | Tensor,
    line: Tensor,
    target: Tensor,
    q: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return by how much (mm) rays miss their points on the stop, and whether they reach it."""
    ray = launch(line, near, q)
    traced = trace_surfaces(system, ray, wavelength, 1.0, first=1, last=system.stop)
    landed = from_lens_axes(traced.ray, system.axes[system.stop - 1])
    return torch.stack((landed.x, landed.y), -1) - target, _reaches(traced)


def _reaches(traced: Trace) -> Tensor:
    """Return which rays meet every surface and are transmitted, inside the apertures or not."""
    reached = torch.ones_like(traced.valid)
    for _, met, _, transmitted in traced.margins:
        for margin in (met, transmitted):
            if margin is not None:
                reached = reached & (margin > 0.0)
    return reached


def _solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """2×2 systems by Cramer's rule; of a singular one, a number that is never used."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    determinant = a * d - b * c
    determinant = torch.where(determinant == 0.0, torch.ones_like(determinant), determinant)
    return torch.stack((d * x - b * y, a * y - c * x), -1) / determinant[..., None]
