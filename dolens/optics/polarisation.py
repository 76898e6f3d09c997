"""Polarisation ray tracing: what a lens does to the electric field along each ray.

The polarisation ray-tracing matrix P takes the field in front of the lens to that behind it, both
as three components in the lens's axes (Yun, Crabtree and Chipman, Appl. Opt. 50, 2855 (2011);
Chipman, Lam and Young, *Polarized Light and Optical Systems*, chapter 9):

    P = ∏ O'·diag(t_s, t_p, 1)·O⁻¹,    O = (s, k × s, k),    O' = (s, k' × s, k'),

with the ray's directions k and k', and s along the normal of the plane of incidence.  s has no
direction at normal incidence, so that P is found in another way.  A surface that changes no field
(t_s = t_p = 1; a mirror r_s = -1, r_p = 1) turns two vectors u₁, u₂ across the ray,

    u' = u - (k + k')·(k'·u)/(1 + k·k');    of a mirror  u' = 2n·(n·u) - u,

with its normal n.  Carried through the lens so, they are axes across the ray in front of each
surface.  There a surface's own effect is a Jones matrix,

    t_s + (t_p - t_s)·w·wᵀ/|w|²,    w = (n·u₁, n·u₂),

with -r_s and r_p of a mirror.  |w| is the sine of the angle of incidence, and t_p - t_s is of its
square's order.  The product J of these is what polarises; the turn of the axes is geometry alone
(Yun, McClain and Chipman, Appl. Opt. 50, 2866 (2011)), and

    P = (u₁', u₂', k')·[[J, 0], [0, 1]]·(u₁, u₂, k)ᵀ.

A crystal passes the field of the ray that is followed: t_s = 0, and w = (a·u₁, a·u₂) of an
extraordinary ray or (a·u₂, -a·u₁) of an ordinary one, a the optic axis, with 1/|w|² for t_p - t_s.
In it k is along the wave vector, not along the ray, and the field is that of D.  Its faces are
ideal: they reflect nothing, and what is not of the ray that is followed goes the other way.

Fields are roots of power: t stands for t·√(n'·cos θ'/(n·cos θ)), so that ½·tr(J†J) is the share of
unpolarised light that arrives.  Time goes as exp(-iωt); the phase of the path is left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.optics.coatings import CoatingState, Stack
from dolens.optics.crystals import Crystal, Uniaxial
from dolens.optics.elements import to_lens_axes
from dolens.optics.materials import is_anisotropic
from dolens.optics.rays import Components, Rays, TracedRays
from dolens.optics.surfaces.deflection import Vector
from dolens.optics.system import OpticalSystem, require_homogeneous, require_no_metasurface
from dolens.optics.thin_films import Parts
from dolens.optics.trace import (
    Crossing,
    enter_lens,
    stop_gradient_where_invalid,
    trace_surfaces,
    trace_to_sensor,
    traced_rays,
)


@dataclass(frozen=True)
class PolarisedRays:
    """Rays after a trace, and what became of the field along them.

    Attributes:
        rays: as `Lens.trace` gives them.
        front: (..., 3, 3), columns: axes u₁ and u₂ across the ray in front of the lens, and its
            direction; in the lens's axes.
        behind: (..., 3, 3), the same behind the last surface, the axes carried there.
        jones: (..., 2, 2), complex, from the axes in front to those behind; see the module.

    Where a ray is invalid, numbers are finite and carry no gradient.
    """

    rays: TracedRays
    front: Tensor
    behind: Tensor
    jones: Tensor

    @property
    def transmission(self) -> Tensor:
        """(...), share of unpolarised light that arrives, ½·tr(J†J)."""
        parts = torch.view_as_real(self.jones).square().sum((-1, -2, -3))
        return 0.5 * parts

    @property
    def matrix(self) -> Tensor:
        """(..., 3, 3), complex: P, in the lens's axes.  It takes k to k'."""
        behind, front = (v.to(self.jones.dtype) for v in (self.behind, self.front))
        across = behind[..., :2] @ self.jones @ front[..., :2].mT
        return across + behind[..., 2:] * front[..., None, :, 2]

    def in_axes(self, front: Tensor, behind: Tensor) -> Tensor:
        """Return Jones matrices (..., 2, 2) between other axes.

        Args:
            front: (..., 3, 2), columns: axes across the ray in front of the lens.
            behind: (..., 3, 2), axes across the ray behind it.
        """
        given = self.front[..., :2].mT @ front.to(self.front)
        wanted = behind.to(self.behind).mT @ self.behind[..., :2]
        return wanted.to(self.jones.dtype) @ self.jones @ given.to(self.jones.dtype)


def double_pole_axes(direction: Tensor, pole: Tensor) -> Tensor:
    """Return axes across rays by Chipman's double-pole coordinates, (..., 3, 2).

    They are the lens's x and y, turned along great circles from z to the pole and from there to
    the ray; there is no singularity but opposite to the pole.  x × y is along the light: where it
    goes towards -z, y is turned over first.

    Args:
        direction: (..., 3), unit vectors.
        pole: (..., 3), unit vectors that the axes turn about as little as they can.
    """
    sign = 1.0 - 2.0 * (pole[..., 2:].detach() < 0.0).to(pole.dtype)
    x, y, z = torch.eye(3, dtype=pole.dtype, device=pole.device)
    start = sign * z
    found = [
        turned(turned(axis, start, pole), pole, direction)
        for axis in (x.expand_as(start), sign * y)
    ]
    return torch.stack(found, -1)


def turned(vector: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Return vectors (..., 3) across `start`, turned as it is turned to `end` by the least angle.

    Both are unit vectors (..., 3), and not opposite.
    """
    cosine = (start * end).sum(-1, keepdim=True)
    return vector - (start + end) * ((vector * end).sum(-1, keepdim=True) / (1.0 + cosine))


def trace_polarised(system: OpticalSystem, rays: Rays) -> PolarisedRays:
    """Trace rays to the sensor, and the field along them.

    The reference traces; all is differentiable, in the lens's precision.

    Args:
        system: the lens.
        rays: as users give them.

    Raises:
        InputError: a coating that is a table of shares, which has no phases, a medium that is a
            gradient, or cells of a metasurface.
    """
    require_homogeneous(system, "polarised rays")
    require_no_metasurface(system, "polarised rays")
    ray, before = enter_lens(system, rays, 1, 1.0)
    crossings: list[Crossing] = []
    wavelength = rays.wavelength
    # Of ideal surfaces the shares are those of the glasses alone.
    ideal = system.uncoated()
    traced = trace_surfaces(
        ideal, ray, wavelength, path_length=True, transmission=True, crossings=crossings
    )
    traced = trace_to_sensor(ideal, traced, wavelength)
    field = _Field(system, crossings, wavelength)
    media = math.prod(share.medium for share in traced.shares or [])
    power = media * field.flux
    root = None
    if isinstance(power, Tensor):
        # What is held here are rays that no light follows.
        root = power.clamp(min=torch.finfo(power.dtype).tiny ** 0.5).sqrt()
    return _joined(traced_rays(replace(traced, shares=None), before), field, root)


def _joined(rays: TracedRays, field: "_Field", root: Tensor | None) -> PolarisedRays:
    """Join what was found for users; the root is that of fluxes and of glasses' transmittances."""
    valid = rays.valid

    def joined(columns: Sequence[Sequence[Tensor]]) -> Tensor:
        """Return (..., rows, columns) of components; of each alone, as that is far faster."""
        rows = zip(*columns, strict=True)
        kept = [
            stop_gradient_where_invalid(v.expand(valid.shape), valid) for row in rows for v in row
        ]
        return torch.stack(kept, -1).unflatten(-1, (-1, len(columns)))

    one = torch.ones_like(field.front[2][0])
    zero = torch.zeros_like(one)
    given = field.jones or [Parts(v) for v in (one, zero, zero, one)]
    parts = [j if root is None else j.times(root) for j in given]
    real = [(j.real, zero if j.imaginary is None else j.imaginary) for j in parts]
    jones = torch.view_as_complex(joined([*zip(*real, strict=True)])).unflatten(-1, (2, 2))
    return PolarisedRays(rays, joined(field.front), joined(field.behind), jones)


class _Field:
    """The field is carried along rays, surface by surface.

    Attributes:
        real: the precision of the rays.
        front: u₁, u₂, k in front of the lens, in its axes.
        behind: the same, carried behind the last surface.
        jones: J₁₁, J₁₂, J₂₁, J₂₂; empty where no surface changes the field.
        flux: ∏ n'·cos θ'/(n·cos θ) of the surfaces with a coating.
    """

    def __init__(
        self, system: OpticalSystem, crossings: list[Crossing], wavelength: float | Tensor
    ) -> None:
        self.system, self.wavelength = system, wavelength
        first = crossings[0]
        k = _to_lens(first, first.arriving)
        self.real = k[0].dtype
        self.front = (*_axes_across(k), k)
        self.behind = self.front
        self.jones: list[Parts] = []
        self.flux: Tensor | float = 1.0
        for crossing in crossings:
            self._cross(crossing)

    def _cross(self, crossing: Crossing) -> None:
        number = crossing.number
        surface, mirror = self.system.surfaces[number - 1], number in self.system.mirrors
        crystal = isinstance(self.system.materials[number], Uniaxial)
        refracts = surface.deflection is not None or crystal or self.system.refracts(number)
        if surface.coating is None and not refracts:
            return
        u, v, k = self.behind
        if surface.coating is not None or mirror:
            normal = surface.shape.normal(surface.parameters, *crossing.point)
            n = _to_lens(crossing, normal)
            w = _dot(n, u), _dot(n, v)
        if surface.coating is not None:
            cosine = _dot(n, k).abs().clamp(max=1.0)
            t, g, flux = _effect(
                surface.coating, mirror, crossing.indices, cosine, w, self.wavelength
            )
            self._pass(t, g, w)
            self.flux = flux if isinstance(self.flux, float) else self.flux * flux
        if not refracts:
            return
        onward = _to_lens(crossing, _wave_normal(crossing.leaving, crossing.indices[1]))
        if mirror:
            carried = [_reflected(n, along, a) for a, along in zip((u, v), w, strict=True)]
        else:
            carried = _turned((u, v), k, onward)
        self.behind = (carried[0], carried[1], onward)
        if crystal:
            self._enter_crystal(number)

    def _enter_crystal(self, number: int) -> None:
        """Keep the field of the ray that is followed: of an extraordinary one that in the plane of
        wave normal and optic axis, of an ordinary one that across.
        """
        u, v, _ = self.behind
        axis = [torch.as_tensor(c).to(u[0]) for c in self.system.optic_axis(number)]
        w = _dot((axis[0], axis[1], axis[2]), u), _dot((axis[0], axis[1], axis[2]), v)
        if not is_anisotropic(self.system.materials[number]):
            w = w[1], -w[0]
        self._pass(Parts(torch.zeros_like(w[0])), Parts(_over_square(w)), w)

    def _pass(self, t: Parts, g: Parts, w: tuple[Tensor, Tensor]) -> None:
        """Multiply by t + g·w·wᵀ."""
        rows = [g.times(w[0]), g.times(w[1])]
        if not self.jones:
            off = rows[0].times(w[1])
            self.jones = [t.plus(rows[0], w[0]), off, off, t.plus(rows[1], w[1])]
            return
        upper, lower = self.jones[:2], self.jones[2:]
        along = [a.times(w[0]).plus(b, w[1]) for a, b in zip(upper, lower, strict=True)]
        self.jones = [
            t.product(j).plus(row.product(n))
            for row, given in zip(rows, (upper, lower), strict=True)
            for j, n in zip(given, along, strict=True)
        ]


def _effect(
    coating: CoatingState,
    mirror: bool,
    indices: tuple[float | Tensor, float | Tensor],
    cosine: Tensor,
    w: tuple[Tensor, Tensor],
    wavelength: float | Tensor,
) -> tuple[Parts, Parts, Tensor | float]:
    """Return t_s, (t_p - t_s)/sin² and n'·cos θ'/(n·cos θ) of a surface; of a mirror -r_s,
    (r_p + r_s)/sin² and 1.
    """
    n, m = indices
    if mirror:
        found = coating.amplitudes(n, m, cosine, wavelength)
        r_s, r_p = Parts.of(found.r_s), Parts.of(found.r_p)
        return r_s.times(-1.0), r_p.plus(r_s).times(_over_square(w)), 1.0
    q = n * cosine
    # Held above zero, where the root has a derivative; no ray goes on there.
    p = ((m - n) * (m + n) + q * q).clamp(min=torch.finfo(q.dtype).tiny ** 0.5).sqrt()
    flux = p / q.clamp(min=torch.finfo(q.dtype).tiny ** 0.25)
    if isinstance(coating, Stack) and not coating.films:
        # In Fresnel's equations the square of the sine is a factor of the difference.
        s = 2.0 * q / (q + p)
        bend = (n - m) * (n - m) * (n + m) * n * n
        g = bend * s / ((m * q + n * p) * (m * m * q + n * n * p))
        return Parts(s), Parts(g), flux
    of_s, of_p = coating.transmitted(n, m, cosine, wavelength)
    return of_s, of_p.plus(of_s, -1.0).times(_over_square(w)), flux


def _over_square(w: tuple[Tensor, Tensor]) -> Tensor:
    """Return 1/w²; zero where what it multiplies, of the order of w², is rounding."""
    square = torch.addcmul(w[0] * w[0], w[1], w[1])
    small = square.detach() < torch.finfo(square.dtype).eps
    return square.masked_fill(small, torch.inf).reciprocal()


def _wave_normal(direction: Vector, index: Any) -> Vector:
    """Return the unit vector along the wave vector, which in a crystal is not along the ray."""
    if not isinstance(index, Crystal):
        return direction
    x, y, z = index.wave_vector(direction)
    length = torch.rsqrt(_dot((x, y, z), (x, y, z)))
    return x * length, y * length, z * length


def _to_lens(crossing: Crossing, direction: Vector) -> Vector:
    """Return a direction, in the axes of a surface, in the lens's."""
    if crossing.axes.rotation is None:
        return direction
    found = to_lens_axes(Components(*direction, *direction), crossing.axes)
    return (found.l, found.m, found.n)


def _axes_across(k: Vector) -> tuple[Vector, Vector]:
    """Return two axes across rays, x and y turned from z, or x and -y from -z."""
    x, y, z = k
    sign = torch.where(z.detach() < 0.0, -1.0, 1.0).to(z.dtype)
    a = 1.0 / (1.0 + sign * z)
    cross = -x * y * a
    second = (sign * cross, sign * (1.0 - y * y * a), -y)
    return (1.0 - x * x * a, cross, -sign * x), second


def _dot(a: Vector, b: Vector) -> Tensor:
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def _turned(axes: tuple[Vector, ...], k: Vector, onward: Vector) -> list[Vector]:
    """Return axes across k, turned as it is turned to another direction by the least angle."""
    # An invalid ray may be turned round.
    share = -1.0 / (1.0 + _dot(k, onward)).clamp(min=1e-3)
    x, y, z = (a + b for a, b in zip(k, onward, strict=True))
    found: list[Vector] = []
    for u in axes:
        f = share * _dot(u, onward)
        found.append(
            (torch.addcmul(u[0], f, x), torch.addcmul(u[1], f, y), torch.addcmul(u[2], f, z))
        )
    return found


def _reflected(n: Vector, along: Tensor, u: Vector) -> Vector:
    """Return 2n·(n·u) - u."""
    twice = 2.0 * along
    return (twice * n[0] - u[0], twice * n[1] - u[1], twice * n[2] - u[2])
