"""Drafts of a lens's section, spots, fans and MTF, made anew in milliseconds when it changes.

No ray is aimed.  Rays of a field start on a grid of the plane that faces it, first over the whole
front of the lens and then where some of them reached the sensor; those that pass every aperture are
the beam.  So a draft differs from an analysis in this: the samples are even in front of the lens,
not on the stop; vignetting factors of a file are left out; the MTF is that of rays times that of a
perfect lens.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.ndimage import label
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.modulation_transfer import (
    diffraction_limited_transfer,
    field_directions,
)
from dolens.analysis.spot_diagram import AIRY, moments
from dolens.errors import InputError
from dolens.optics.aiming import field_line, launch
from dolens.optics.lens import Lens
from dolens.optics.paraxial import FirstOrder
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, TracedRays
from dolens.optics.surfaces.clear_aperture import Circle
from dolens.optics.system import OpticalSystem
from dolens.plotting.section import Profile, ray_paths, surface_profile

# Rays along a side of the grid over the front of a lens, of a finer one for beams that it misses,
# and over a beam; rays of a beam that place its grid well enough.
_COARSE, _FINE, _BEAM, _ENOUGH = 33, 161, (15, 41), 60
_NARROWINGS = 4
# Neighbours on a grid, in its plane alone.
_IN_PLANE = np.zeros((3, 3, 3), bool)
_IN_PLANE[1] = True
# Of all beams together, about.
_RAYS = 20_000
# Places along a line through a beam, of which its ends are found; and rays of a fan.
_LINE, _FAN = 401, 21
_FREQUENCIES, _BINS = 41, 1024
# Points of a profile; and of one with more, every so many.
_POINTS, _EVERY = 41, 5


@dataclass(frozen=True)
class Draft:
    """What a lens does to the light of F fields and W wavelengths, N rays each.

    Attributes:
        lens: as it is, in double precision.
        where: fields, wavelengths with their weights, and object distance.
    """

    lens: Lens
    where: Conditions

    @cached_property
    def _lines(self) -> tuple[Tensor, Any]:
        """Return unit vectors (F, 3) of the fields' lines, and the object's vergence."""
        points, distance = self.where.fields, self.where.object_distance
        return field_line(torch.deg2rad(points) if distance is None else points, distance)

    def _launched(self, q: Tensor, which: Tensor | None = None) -> Components:
        """Return rays through points q (F, ..., 2) of the planes that face the fields."""
        line, near = self._lines
        line = line if which is None else line[which]
        return launch(line.reshape(-1, *(1,) * (q.ndim - 2), 3), near, q)

    def _traced(self, q: Tensor, wavelength: Any, which: Tensor | None = None) -> TracedRays:
        ray = self._launched(q, which)
        return trace_rays(self.lens.system(), Rays.from_components(ray, wavelength))

    @cached_property
    @torch.no_grad()
    def _seeds(self) -> Tensor | None:
        """Return where the chief rays of the paraxial entrance pupil cross the facing planes,
        (F, 2), mm; None where beams are looked for without: they may be of several parts, or
        nothing is known of them.
        """
        system = self.lens.system()
        pupil = self.first.entrance_pupil.z.double()
        parts = any(surface.aperture.obscuration is not None for surface in system.surfaces)
        if parts or system.breaks or not bool(pupil.isfinite()):
            return None
        line, near = self._lines
        n = line[:, 2]
        across = torch.stack((-line[:, 0] * n, -line[:, 1] * n, 1.0 - n * n), -1) * pupil
        across = across / (1.0 + n * n * near * pupil)[:, None]
        return across[:, :2] - line[:, :2] * (across[:, 2] / (1.0 + n))[:, None]

    @cached_property
    @torch.no_grad()
    def boxes(self) -> Tensor:
        """Return corners (F, 2, 2), mm, of the rectangles of the facing planes that beams of the
        reference wavelength fill; NaN of a field that no light reaches.
        """
        system, wave = self.lens.system(), self.where.reference_wavelength
        number = system.met[0]
        front = system.surfaces[number - 1]
        edge = torch.tensor([0.0, front.semi_diameter], dtype=torch.float64)
        sag, *_, exists = front.sag_and_slopes(edge.new_zeros(2), edge)
        reach = front.semi_diameter + float(sag[exists].abs().amax())
        reach += abs(float(system.vertices[number - 1]))
        count = len(self.where.fields)
        found = torch.full((count, 2, 2), math.nan, dtype=torch.float64)
        box = torch.tensor([[-reach] * 2, [reach] * 2], dtype=torch.float64).repeat(count, 1, 1)
        left, side = torch.arange(count), _COARSE
        for attempt in range(_NARROWINGS):
            q = _grid(box[left], side)
            passes = self._in_beam(q, self._traced(q, wave, left).valid, left)
            step = (box[left, 1] - box[left, 0]) / (side - 1)
            low = torch.where(passes[..., None], q, math.inf).amin(1) - step
            high = torch.where(passes[..., None], q, -math.inf).amax(1) + step
            rays, lit = passes.sum(-1), passes.any(-1)
            box[left] = torch.where(lit[:, None, None], torch.stack((low, high), 1), box[left])
            found[left[lit]] = box[left[lit]]
            # A beam that the grid hardly meets is looked at again, and one that it misses finer.
            again = (rays < _ENOUGH) & (lit | (attempt == 0))
            side = _FINE if attempt == 0 and not bool(lit.all()) else _COARSE
            left = left[again]
            if not len(left):
                break
        return found

    def _in_beam(self, q: Tensor, passes: Tensor, which: Tensor) -> Tensor:
        """Return which rays (F, N) of square grids q (F, N, 2) belong to the beam: those that pass,
        and are neighbours' neighbours of the one nearest to the chief ray.

        Where nothing but the stop clips, strongly aberrated rays may pass it far from their beam.
        """
        if self._seeds is None:
            return passes
        away = (q - self._seeds[which, None]).norm(dim=-1).where(passes, math.inf)
        side = math.isqrt(q.shape[1])
        parts, _ = label(passes.reshape(-1, side, side).numpy(), _IN_PLANE)
        part = torch.from_numpy(parts).reshape(len(q), -1)
        return passes & (part == part.gather(1, away.argmin(-1, keepdim=True)))

    @cached_property
    @torch.no_grad()
    def _beams(self) -> tuple[TracedRays, Tensor]:
        """Return beams (F, W, N) at the sensor, and which of their rays belong to them."""
        count, waves = len(self.where.fields), self.where.wavelengths
        side = min(max(math.isqrt(_RAYS // (count * len(waves))), _BEAM[0]), _BEAM[1])
        q = _grid(self.boxes.nan_to_num(0.0), side)
        hit = self._traced(q[:, None], waves[:, None])
        every = torch.arange(count)
        inside = [self._in_beam(q, passes, every) for passes in hit.valid.unbind(1)]
        return hit, torch.stack(inside, 1) & self.boxes[:, :1, :1].isfinite()

    @cached_property
    def lit(self) -> Tensor:
        """Return (F,), whether a beam reaches the sensor: one ray, along the axis, may always."""
        return self._beams[1].sum((-2, -1)) >= _BEAM[0]

    @cached_property
    def _light(self) -> Tensor:
        """Return shares (F, W·N) of rays in their fields' light, before apertures clip any."""
        passes = self._beams[1] & self.lit[:, None, None]
        return (passes * self.where.weights[:, None]).flatten(1)

    @cached_property
    def spots(self) -> tuple[Tensor, Tensor]:
        """Return points (F, W, N, 2), mm, from the centroids of all wavelengths together, NaN of
        rays that do not pass; and RMS radii (F,), mm, NaN of dark fields.
        """
        points = self._beams[0].position[..., :2]
        centroid, square = moments(points.flatten(1, 2), self._light)
        points = points - centroid[:, None, None]
        return points.where(self._beams[1][..., None], math.nan), square.sqrt()

    @cached_property
    def focus_shift(self) -> float:
        """Return how far behind the sensor, mm, the mean square of all spots is least; 0 where
        light does not depend on it.
        """
        direction = self._beams[0].direction
        slope = (direction[..., :2] / direction[..., 2:]).flatten(1, 2)
        points = self._beams[0].position[..., :2].flatten(1, 2)
        share = self._light / self._light.sum(-1, keepdim=True).clamp(min=1e-30)

        def spread(a: Tensor, b: Tensor) -> Tensor:
            both = (share[..., None] * a * b).sum((-2, -1))
            means = [(share[..., None] * part).sum(-2) for part in (a, b)]
            return (self.where.field_weights * (both - (means[0] * means[1]).sum(-1))).sum()

        blur = float(spread(slope, slope))
        return -float(spread(points, slope)) / blur if blur > 1e-12 else 0.0

    @cached_property
    @torch.no_grad()
    def _lines_through(self) -> Tensor:
        """Return points (F, 2, P, 2) of the facing planes, along y and along x through the middles
        of the beams of the reference wavelength, from one end to the other.
        """
        box = self.boxes.nan_to_num(0.0)
        share = torch.linspace(0.0, 1.0, _LINE, dtype=torch.float64)
        part = torch.linspace(0.0, 1.0, _FAN, dtype=torch.float64)
        middle, found = box.mean(1), []
        for axis in (1, 0):
            q = middle[:, None].repeat(1, _LINE, 1)
            q[..., axis] = box[:, :1, axis] * (1.0 - share) + box[:, 1:, axis] * share
            passes, along = self._traced(q, self.where.reference_wavelength).valid, q[..., axis]
            passes = _about_the_middle(passes)
            low = torch.where(passes, along, math.inf).amin(-1)
            high = torch.where(passes, along, -math.inf).amax(-1)
            low, high = (e.where(low <= high, middle[:, axis])[:, None] for e in (low, high))
            q = q[:, :_FAN].clone()
            q[..., axis] = low * (1.0 - part) + high * part
            middle[:, axis] = q[:, _FAN // 2, axis]
            found.append(q)
        return torch.stack(found, 1)

    @torch.no_grad()
    def section_rays(self, start: float, rays: int) -> list[np.ndarray]:
        """Return the rays of each field in the y-z plane, of the reference wavelength: z and y
        (rays, points, 2), mm; none of fields beside that plane.

        Args:
            start: z where rays begin, mm, or at the object where that is nearer.
            rays: of each field.
        """
        every = torch.linspace(0, _FAN - 1, rays).round().long()
        ray = self._launched(self._lines_through[:, 0][:, every])
        paths, arrive = _paths(self.lens.system(), ray, self.where.reference_wavelength)
        if self.where.object_distance is not None:
            start = max(start, -self.where.object_distance)
        first, towards = paths[..., 0, :], torch.stack(ray[3:], -1)
        ahead = towards * (start - first[..., 2:]) / towards[..., 2:].clamp(min=1e-3)
        # Rays of wide fields would begin far beside the lens.
        limit = 3.0 * float(paths[arrive][..., 1].abs().amax()) if bool(arrive.any()) else 1.0
        ahead = ahead * (limit / ahead.norm(dim=-1, keepdim=True).clamp(min=limit))
        paths = torch.cat(((first + ahead)[..., None, :], paths[..., 1:, :]), -2)
        arrive = arrive & (self.lit & (self.where.fields[:, 0] == 0.0))[:, None]
        return [some[ok][..., [2, 1]].numpy() for some, ok in zip(paths, arrive, strict=True)]

    def ray_fans(self) -> Tensor:
        """Return transverse aberrations (F, W, 2, P), µm: y of rays along y, x of rays along x,
        less those of the reference wavelength in the beam's middle; NaN of rays that do not pass.
        """
        lines = self._lines_through[:, None]
        hit = self._traced(lines, self.where.wavelengths[:, None, None])
        middle = self._traced(lines[:, 0, 0, _FAN // 2, None], self.where.reference_wavelength)
        away = hit.position[..., :2] - middle.position[:, 0, None, None, None, :2]
        landed = torch.stack((away[:, :, 0, :, 1], away[:, :, 1, :, 0]), 2)
        return 1e3 * landed.where(hit.valid & self.lit[:, None, None, None], math.nan)

    @torch.no_grad()
    def modulation(self) -> tuple[Tensor, Tensor]:
        """Return frequencies (Q,), cycles/mm, and contrast (F, 2, Q), tangential and sagittal: that
        of rays times that of a perfect lens; NaN of dark fields.

        Frequencies end at 1, 2 or 5 times a power of ten, where the sharpest field leaves little.
        """
        points, rms = self.spots
        # Of a lens without power, which has no pupil that diffracts, zero.
        number = float(self.first.working_f_number.abs().nan_to_num(0.0, 0.0))
        waves = 1e-6 * self.where.wavelengths
        cutoff = float(1.0 / (waves * number).min())
        end = min(cutoff, 0.68 / max(float(rms.nan_to_num(math.inf).min()), 1e-9))
        power = 10.0 ** math.floor(math.log10(end))
        end = next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= 0.999 * end)
        frequency = torch.linspace(0.0, end, _FREQUENCIES, dtype=torch.float64)
        limit = diffraction_limited_transfer(frequency, self.where.wavelengths[:, None], number)
        along = field_directions(self.where)
        ways = torch.stack((along, torch.stack((along[:, 1], -along[:, 0]), -1)), 1)
        heights = points.nan_to_num(0.0).flatten(1, 2) @ ways.mT  # (F, N, 2)
        place, line = _line_spread(heights.mT, self._light)
        phase = (2.0 * math.pi) * place[:, None] * frequency
        curves = torch.hypot(line @ phase.cos(), line @ phase.sin()) * (self.where.weights @ limit)
        return frequency, curves.where(self.lit[:, None, None], math.nan)

    @cached_property
    @torch.no_grad()
    def first(self) -> FirstOrder:
        """Return first-order data of the y-z section at the reference wavelength."""
        where = self.where
        return self.lens.first_order(where.reference_wavelength, where.object_distance, "y")

    @property
    def airy_radius(self) -> float:
        """Return Airy's radius at the reference wavelength, mm; 0 of a lens without power."""
        number = float(self.first.working_f_number.abs().nan_to_num(0.0, 0.0))
        return AIRY * 1e-6 * self.where.reference_wavelength * number

    def check(self) -> None:
        """Raise `InputError` where no light of the first field reaches the sensor."""
        if not bool(self.lit[0]):
            raise InputError("no ray of the first field reaches the sensor")


def _about_the_middle(passes: Tensor) -> Tensor:
    """Return those of rays (F, P) that pass with all between them and the middle one; where that
    does not pass itself, all that do.
    """
    half = passes.shape[-1] // 2
    behind = passes[:, half:].long().cumprod(-1)
    before = passes[:, : half + 1].flip(-1).long().cumprod(-1).flip(-1)
    together = torch.cat((before, behind[:, 1:]), -1).bool()
    return torch.where(passes[:, half, None], together, passes)


@torch.no_grad()
def section_profiles(system: OpticalSystem) -> list[Profile]:
    """Return z and y of every surface as `surface_profile` does, with fewer points, and faster
    where all are circles about one axis.
    """
    if system.breaks or system.elements:
        every = (surface_profile(system, n) for n in range(1, len(system.surfaces) + 1))
        return [(z[::_EVERY], y[::_EVERY]) for z, y in every]
    share = torch.linspace(-1.0, 1.0, _POINTS, dtype=torch.float64)
    found = []
    for number, (surface, vertex) in enumerate(
        zip(system.surfaces, system.vertices[:-1], strict=True), 1
    ):
        edge = surface.aperture.edge
        if not isinstance(edge, Circle):
            z, y = surface_profile(system, number)
            found.append((z[::_EVERY], y[::_EVERY]))
            continue
        heights = share * edge.semi_diameter
        sag, _, _, exists = surface.sag_and_slopes(torch.zeros_like(heights), heights)
        found.append(((sag + vertex)[exists].numpy(), heights[exists].numpy()))
    return found


def _line_spread(heights: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return places (B,), mm, and the shares of light (F, 2, B) at them, of rays that land at
    heights (F, 2, N) with light (F, N): each is shared by its two neighbours.
    """
    reach = float(heights.abs().amax()) or 1.0
    at = (heights + reach) * ((_BINS - 1) / (2.0 * reach))
    below = at.floor().clamp(0, _BINS - 2)
    above = at - below
    share = (light / light.sum(-1, keepdim=True).clamp(min=1e-30))[:, None].expand_as(at)
    line = heights.new_zeros(*heights.shape[:-1], _BINS)
    line.scatter_add_(-1, below.long(), share * (1.0 - above))
    line.scatter_add_(-1, below.long() + 1, share * above)
    return torch.linspace(-reach, reach, _BINS, dtype=heights.dtype), line


def _paths(system: OpticalSystem, ray: Components, wavelength: float) -> tuple[Tensor, Tensor]:
    """Return what `ray_paths` does, by kernels where light goes straight on along one axis."""
    if system.breaks or system.elements or system.mirrors or system.gradients:
        return ray_paths(system, ray, wavelength)
    rays = step = Rays.from_components(ray, wavelength)
    points = [rays.position]
    for number in system.met:
        hit = trace_rays(system, step, first=number, last=number)
        step = Rays(hit.position, hit.direction, wavelength)
        points.append(hit.position)
    hit = trace_rays(system, rays)
    return torch.stack([*points, hit.position], -2), hit.valid


def _grid(boxes: Tensor, side: int) -> Tensor:
    """Return points (F, side², 2) of rectangles (F, 2, 2)."""
    share = torch.linspace(0.0, 1.0, side, dtype=torch.float64)
    place = torch.stack(torch.meshgrid(share, share, indexing="ij"), -1).reshape(-1, 2)
    return boxes[:, None, 0] + place * (boxes[:, None, 1] - boxes[:, None, 0])
