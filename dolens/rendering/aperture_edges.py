"""Edges of apertures: where they cut the light of sensor points in the exit pupil, and rays along
them, which carry the derivative that a clipped integral has.

A pixel's irradiance is an integral over the part of the exit pupil's disc that passes the lens.
When the lens changes, the edge of that part moves, and with it light comes or goes at the edge
itself.  With the edge at R(φ; θ) in polar coordinates about the middle of the light,

    ∂/∂θ ∫dφ ∫_0^R f r dr  =  ∫dφ ∫_0^R ∂f/∂θ r dr  +  ∫dφ f(R) R ∂R/∂θ.

Sampled rays have the first term.  Rays at the edge have the second: their weight is zero, and its
gradient is f's factor R ∂R/∂θ.  What collects rays by their weights needs to know nothing of it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status
from dolens.optics.system import OpticalSystem
from dolens.rendering.exit_pupil import ExitPupil, edge_distances, rays_to_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem

# Azimuths of the edge, points along each side of the disc in the search for its middle, and
# halvings of the interval that the edge lies in: Newton's iteration does the rest.
AZIMUTHS, _SIDE, _HALVINGS = 48, 20, 10
# Radii of a symmetric lens, or points along each side of the sensor of another.
_RADII, _GRID = 17, 5
# An edge as near to the disc's own cuts no light that counts.
UNCUT = 0.999


@dataclass(frozen=True)
class PupilBoundary:
    """The edge of the light of F points of the sensor, in polar coordinates about its middle.

    Coordinates are those of the disc, in units of its radius.

    Attributes:
        middle: (F, 2), from where every ray to the edge lies in the light.
        radius: (F, AZIMUTHS), distance of the edge from the middle, at azimuths 2πj/AZIMUTHS.
        surface: (F, AZIMUTHS), number of the surface that ends the light there; 0 where the disc
            itself does, or what is no edge of an aperture (a total reflection).
    """

    middle: Tensor
    radius: Tensor
    surface: Tensor


@torch.no_grad()
def pupil_boundary(
    system: OpticalSystem,
    wavelength: float,
    points: tuple[Tensor, Tensor],
    pupil: ExitPupil,
) -> PupilBoundary | None:
    """Search for the edges of the light of points of the sensor, at one wavelength.

    One trace tells where nothing cuts the disc; the answer is then None.

    Args:
        system: the lens.
        wavelength: nm.
        points: x and y, mm, each (F,).
        pupil: the disc, numbers.
    """
    probe = _Probe(system, wavelength, points, pupil)
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    angle = torch.arange(AZIMUTHS, **options) * (2.0 * math.pi / AZIMUTHS)
    arms = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    if bool(probe.passes((UNCUT * arms).expand(len(points[0]), -1, 2))[0].all()):
        return None
    middle = probe.middles()
    along = middle @ arms.mT
    reach = -along + (along.square() + 1.0 - middle.square().sum(-1, keepdim=True)).sqrt()

    def tried(radius: Tensor) -> Tensor:
        return middle[:, None] + radius[..., None] * arms

    passes, _ = probe.passes(tried(UNCUT * reach))
    low, high = torch.where(passes, reach, torch.zeros_like(reach)), reach
    for _ in range(_HALVINGS):
        halfway = 0.5 * (low + high)
        inside, _ = probe.passes(tried(halfway))
        inside = inside | passes
        low, high = torch.where(inside, halfway, low), torch.where(inside, high, halfway)
    _, surface = probe.passes(tried(high))
    cut = ~passes & (low > 0.0)
    surface = torch.where(cut, surface, 0)
    if not bool((surface > 0).any()):
        return None
    return PupilBoundary(middle, 0.5 * (low + high), surface)


class _Probe:
    """Asks which rays of F points through places (F, N, 2) of the disc pass."""

    def __init__(
        self,
        system: OpticalSystem,
        wavelength: float,
        points: tuple[Tensor, Tensor],
        pupil: ExitPupil,
    ) -> None:
        self.system, self.wavelength, self.pupil = system, wavelength, pupil
        self.x, self.y = (p.to(device=system.device, dtype=system.dtype)[:, None] for p in points)

    def passes(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return which rays pass, and the surface whose edge stops a ray; 0 where none does."""
        across, up = (self.pupil.radius * places).unbind(-1)
        ray = rays_to_exit_pupil(self.x, self.y, self.system.vertices[-1], across, up, self.pupil.z)
        rays = Rays.from_components(ray, self.wavelength)
        hit = trace_rays(self.system, rays, -1.0)
        clipped = hit.status == Status.VIGNETTED
        valid = hit.valid & (hit.direction[..., 2] < 0.0)
        return valid, torch.where(clipped, hit.surface.long(), 0)

    def middles(self) -> Tensor:
        """(F, 2): the mean of the places that pass; the disc's centre where all do."""
        options: dict[str, Any] = {"dtype": self.system.dtype, "device": self.system.device}
        axis = (torch.arange(_SIDE, **options) + 0.5) * (2.0 / _SIDE) - 1.0
        places = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        places = places[places.norm(dim=-1) < 1.0]
        passing, _ = self.passes(places.expand(len(self.x), -1, 2))
        share = passing.to(places)
        middle = share @ places / share.sum(1, keepdim=True).clamp(min=1.0)
        middle[passing.all(1)] = 0.0
        return middle


@dataclass(frozen=True)
class PupilBoundaryMap:
    """Edges found at a few points of a sensor, for all of its pixels.

    Attributes:
        edges: at the points.
        symmetric: the points lie on the positive x axis, and others are turned there.
        low: distance of the first radius from the axis, mm; or x and y of the first corner.
        step: mm between neighbouring points.
    """

    edges: PupilBoundary
    symmetric: bool
    low: tuple[float, float]
    step: tuple[float, float]

    def at(self, x: Tensor, y: Tensor, angle: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The edges of points' light at azimuths.

        Args:
            x: (P,), mm.
            y: (P,), mm.
            angle: (P, J), azimuths about the middle of the light, radians.

        Returns:
            The middles (P, 1, 2), the arms (P, J, 2), unit vectors, the radii (P, J) and the
            numbers of the surfaces (P, J), all in the frame of the disc.
        """
        turn = torch.atan2(y, x) if self.symmetric else torch.zeros_like(x)
        place = angle.remainder(2.0 * math.pi) * (AZIMUTHS / (2.0 * math.pi))
        first = place.long().clamp(max=AZIMUTHS - 1)
        after, part = (first + 1) % AZIMUTHS, place - first
        nodes, shares = self._nodes(x, y)
        middle, radius = x.new_zeros(len(x), 2), torch.zeros_like(part)
        for node, share in zip(nodes, shares, strict=True):
            rows = self.edges.radius[node]
            found = torch.lerp(rows.gather(1, first), rows.gather(1, after), part)
            middle = middle + share[:, None] * self.edges.middle[node]
            radius = radius + share[:, None] * found
        nearest = torch.stack(nodes).gather(0, torch.stack(shares).argmax(0, keepdim=True))[0]
        closer = torch.where(part < 0.5, first, after)
        surface = self.edges.surface[nearest].gather(1, closer)
        arms = torch.stack((torch.cos(angle + turn[:, None]), torch.sin(angle + turn[:, None])), -1)
        cosine, sine = torch.cos(turn), torch.sin(turn)
        middle = torch.stack(
            (
                cosine * middle[:, 0] - sine * middle[:, 1],
                sine * middle[:, 0] + cosine * middle[:, 1],
            ),
            -1,
        )
        return middle[:, None], arms, radius, surface

    def _nodes(self, x: Tensor, y: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Numbers of the points around others, and the shares of linear interpolation."""
        if self.symmetric:
            place = (torch.hypot(x, y) - self.low[0]) / self.step[0]
            first = place.long().clamp(0, _RADII - 2)
            part = (place - first).clamp(0.0, 1.0)
            return [first, first + 1], [1.0 - part, part]
        nodes, shares = [], []
        down, across = (
            (p - low) / step
            for p, low, step in zip((y, x), self.low[::-1], self.step[::-1], strict=True)
        )
        for row, row_share in _neighbours(down):
            for column, column_share in _neighbours(across):
                nodes.append(row * _GRID + column)
                shares.append(row_share * column_share)
        return nodes, shares


def _neighbours(place: Tensor) -> list[tuple[Tensor, Tensor]]:
    first = place.long().clamp(0, _GRID - 2)
    part = (place - first).clamp(0.0, 1.0)
    return [(first, 1.0 - part), (first + 1, part)]


@torch.no_grad()
def pupil_boundary_map(imaging: ImagingSystem) -> PupilBoundaryMap | None:
    """Find the edges of the light all over a sensor; None where nothing cuts the disc.

    Args:
        imaging: the lens, the pixels, the pupil's disc, numbers, and wavelengths, of which the
            middle one's edges start the search for the others'.
    """
    system, sensor, wavelengths = imaging.system, imaging.sensor, imaging.scene.wavelengths
    options: dict[str, Any] = {"dtype": torch.float64, "device": system.device}
    ends = torch.tensor([0.0, 1.0], **options)
    rows, columns = (
        (ends * side - 0.5).repeat_interleave(n).repeat(2 // n)
        for side, n in ((sensor.height, 2), (sensor.width, 1))
    )
    x, y = sensor.positions(rows, columns)
    wavelength = wavelengths[len(wavelengths) // 2]
    symmetric = system.rotationally_symmetric
    if symmetric:
        low, high = _distances(x, y)
        radius = torch.linspace(low, high, _RADII, **options)
        points = (radius, torch.zeros_like(radius))
        corner, step = (low, 0.0), (max(high - low, 1e-12) / (_RADII - 1), 1.0)
    else:
        corner = (float(x.min()), float(y.min()))
        step = (
            float(x.max() - x.min()) / (_GRID - 1),
            float(y.max() - y.min()) / (_GRID - 1),
        )
        grid = torch.arange(_GRID, **options)
        up, across = torch.meshgrid(
            corner[1] + grid * step[1], corner[0] + grid * step[0], indexing="ij"
        )
        points = (across.reshape(-1), up.reshape(-1))
    edges = pupil_boundary(system, wavelength, points, imaging.pupil)
    return None if edges is None else PupilBoundaryMap(edges, symmetric, corner, step)


def _distances(x: Tensor, y: Tensor) -> tuple[float, float]:
    """The least and the largest distance from the axis of a rectangle's points, by its corners."""
    least = [0.0 if float(p.min()) < 0.0 < float(p.max()) else float(p.abs().min()) for p in (x, y)]
    return math.hypot(*least), float(torch.hypot(x, y).max())


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
            inside, passes, other, light = self._through(radius * (1.0 - beside), still)
            place = (self.middle + radius[..., None] * self.arms).norm(dim=-1)
            counts = passes & (place < 1.0) & (slope < 0.0) & (radius > 0.0)
            safe = torch.where(slope < 0.0, slope, -1.0)
            share = (still.radius / still.axial_radius) ** 2
            share = share / still.axial_mean(float(self.system.vertices[-1].detach()))
            # cos⁴ of the ray at the sensor, as every sample's.
            bright = light * self.rays(radius, still).n ** 4
            factor = torch.where(counts, -2.0 * radius * bright * share / safe, 0.0)
        distance = self.distance(radius, self.pupil)
        moved = distance - distance.detach()
        return _Found(inside, factor * moved, counts, other)

    def _through(
        self, radius: Tensor, pupil: ExitPupil
    ) -> tuple[Components, Tensor, Tensor, Tensor | float]:
        """Rays before the lens, which got there, the edge that stopped the others, or 0, and the
        share of light that a lens with coatings passes.
        """
        rays = Rays.from_components(self.rays(radius, pupil), self.wavelength)
        hit = trace_rays(self.system, rays, -1.0, transmission=self.system.coated)
        there = hit.components()
        clipped = torch.where(hit.status == Status.VIGNETTED, hit.surface.long(), 0)
        light = 1.0 if hit.transmission is None else hit.transmission
        return there, hit.valid & (there.n < 0.0), clipped, light
