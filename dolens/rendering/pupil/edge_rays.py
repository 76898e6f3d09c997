"""Rays along the edges of apertures, which carry the derivative that a clipped integral has.

A pixel's irradiance is an integral over the part of the exit pupil's disc that passes the lens.
When the lens changes, the edge of that part moves, and with it light comes or goes at the edge
itself.  With the edge at R(φ; θ) in polar coordinates about the middle of the light,

    ∂/∂θ ∫dφ ∫_0^R f r dr  =  ∫dφ ∫_0^R ∂f/∂θ r dr  +  ∫dφ f(R) R ∂R/∂θ.

Sampled rays have the first term.  Rays at the edge have the second: their weight is zero, and its
gradient is f's factor R ∂R/∂θ.  What collects rays by their weights needs to know nothing of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status
from dolens.optics.system import OpticalSystem
from dolens.rendering.pupil.exit_pupil import ExitPupil
from dolens.rendering.pupil.limiting_aperture import edge_distances
from dolens.rendering.pupil.rays_to_exit_pupil import rays_to_exit_pupil

# The share of the radius that differences are taken over, and for each precision the steps towards
# the edge by one slope.
_STEP, _ITERATIONS = 1e-3, {torch.float64: 3, torch.float32: 2}
# A ray inside by this share of the radius tells whether this is the edge of the light: where two
# edges nearly coincide the farther one must not pass for it.
_BESIDE = {torch.float64: 1e-6, torch.float32: 3e-4}
# How often another edge is tried where the first is not the light's.
_ROUNDS = 3


class EdgeRays(NamedTuple):
    """Rays (C, P, J) in object space at the edge of the light of P points.

    Attributes:
        ray: no gradient.
        weight: zeros whose gradients are the edge's; in units in which a sample of the disc that
            stands for a share s of its area has the weight s · cos⁴ · (radius/axial radius)² over
            the axial mean of cos⁴.
    """

    ray: Components
    weight: Tensor


def edge_rays(
    system: OpticalSystem,
    wavelengths: Sequence[float],
    points: tuple[Tensor, Tensor],
    pupil: ExitPupil,
    edge: tuple[Tensor, Tensor, Tensor, Tensor],
) -> EdgeRays | None:
    """Rays at the edge of the light, from where it roughly is.

    Args:
        system: the lens, differentiable.
        wavelengths: nm, C of them.
        points: x and y on the sensor, mm, each (P,).
        pupil: the disc, of `differentiable_exit_pupil`.
        edge: middles (P, 1, 2), arms (P, J, 2), radii (P, J) and surfaces (P, J) in units of the
            disc's radius, as `PupilBoundaryMap.at` gives them; J azimuths that are spread evenly.

    Returns:
        None where no edge cuts the disc.
    """
    middle, arms, radius, surface = edge
    if not bool((surface > 0).any()):
        return None
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    every = torch.tensor(wavelengths, dtype=torch.float64, device=system.device)[:, None]
    shape = (len(wavelengths), *surface.shape)
    weight = torch.zeros(shape, **options)
    parts = [torch.zeros(shape, **options) for _ in range(6)]
    parts[5].fill_(-1.0)
    done = torch.zeros(shape, dtype=torch.bool, device=system.device)
    for _ in range(_ROUNDS):
        others = torch.zeros_like(surface)
        for number in torch.unique(surface[surface > 0]).tolist():
            where = surface == number
            beam = _Beam(
                system,
                every,
                tuple(p.to(**options)[:, None].expand(where.shape)[where] for p in points),
                pupil,
                middle.to(**options).expand(*where.shape, 2)[where],
                arms.to(**options)[where],
                int(number),
            )
            found = beam.at_edge(radius.to(**options)[where])
            new = found.counts & ~done[:, where]
            weight = _added(weight, where, torch.where(new, found.weight, 0.0) / surface.shape[-1])
            parts = [
                _filled(part, where, torch.where(new, c, part[:, where]))
                for part, c in zip(parts, found.ray, strict=True)
            ]
            done = _filled(done, where, done[:, where] | new)
            others[where] = torch.where(new, 0, found.other).amax(0)
        # Near where two edges cross, the light ends at the other one.
        surface = torch.where(done.all(0), 0, others)
        if not bool((surface > 0).any()):
            break
    return EdgeRays(Components(*parts), weight)


def _added(whole: Tensor, where: Tensor, values: Tensor) -> Tensor:
    """(C, P, J) with values (C, n) added where a mask (P, J) says so."""
    return whole + torch.zeros_like(whole).masked_scatter(where.expand(whole.shape), values)


class _Found(NamedTuple):
    """Rays (C, n) in object space, their weights, which of them are at the light's edge, and the
    surface whose edge is within it, or 0.
    """

    ray: Components
    weight: Tensor
    counts: Tensor
    other: Tensor


def _filled(whole: Tensor, where: Tensor, values: Tensor) -> Tensor:
    """(C, P, J) with values (C, n) where a mask (P, J) says so."""
    return whole.masked_scatter(where.expand(whole.shape), values)


@dataclass(frozen=True)
class _Beam:
    """Rays of n points of the sensor to places on arms from middles, towards one surface's edge."""

    system: OpticalSystem
    wavelength: Tensor
    points: tuple[Tensor, ...]
    pupil: ExitPupil
    middle: Tensor
    arms: Tensor
    surface: int

    def rays(self, radius: Tensor, pupil: ExitPupil) -> Components:
        """Towards radii (C, n) on the arms."""
        across, up = (self.middle + radius[..., None] * self.arms).unbind(-1)
        x, y = self.points
        sensor_z = self.system.vertices[-1]
        return rays_to_exit_pupil(x, y, sensor_z, across * pupil.radius, up * pupil.radius, pupil.z)

    def distance(self, radius: Tensor, pupil: ExitPupil) -> Tensor:
        """Return the distance inside the edge, mm."""
        ray = self.rays(radius, pupil)
        return edge_distances(self.system, ray, self.surface, self.wavelength)

    @torch.no_grad()
    def refined(self, radius: Tensor, pupil: ExitPupil) -> tuple[Tensor, Tensor]:
        """The radius where the edge is, and how the distance from it falls with the radius."""
        step = _STEP * radius
        distance = self.distance(radius, pupil)
        slope = (self.distance(radius + step, pupil) - distance) / step
        falling = torch.where(slope < 0.0, slope, -torch.inf)
        for _ in range(_ITERATIONS[self.system.dtype] - 1):
            radius = radius - (distance / falling).clamp(-0.1, 0.1)
            distance = self.distance(radius, pupil)
        radius = radius - (distance / falling).clamp(-0.1, 0.1)
        return radius, slope

    def at_edge(self, radius: Tensor) -> _Found:
        """Rays (C, n) at the edge, from radii (n,) near it; weights are those of J = 1 azimuths."""
        still = self.pupil.numbers()
        radius = radius.expand(len(self.wavelength), -1)
        radius, slope = self.refined(radius, still)
        with torch.no_grad():
            beside = _BESIDE[self.system.dtype]
            inside, passes, other = self._through(radius * (1.0 - beside), still)
            place = (self.middle + radius[..., None] * self.arms).norm(dim=-1)
            counts = passes & (place < 1.0) & (slope < 0.0) & (radius > 0.0)
            safe = torch.where(slope < 0.0, slope, -1.0)
            share = (still.radius / still.axial_radius) ** 2
            share = share / still.axial_mean(float(self.system.vertices[-1].detach()))
            # cos⁴ of the ray at the sensor, as every sample's.
            bright = self.rays(radius, still).n ** 4
            factor = torch.where(counts, -2.0 * radius * bright * share / safe, 0.0)
        distance = self.distance(radius, self.pupil)
        moved = distance - distance.detach()
        return _Found(inside, factor * moved, counts, other)

    def _through(self, radius: Tensor, pupil: ExitPupil) -> tuple[Components, Tensor, Tensor]:
        """Rays before the lens, which got there, and the edge that stopped the others, or 0."""
        rays = Rays.from_components(self.rays(radius, pupil), self.wavelength)
        hit = trace_rays(self.system, rays, -1.0)
        there = hit.components()
        clipped = torch.where(hit.status == Status.VIGNETTED, hit.surface.long(), 0)
        return there, hit.valid & (there.n < 0.0), clipped
