"""Paraxial rays of a lens: the marginal and the chief ray, and first-order optics in plain numbers.

Besides them: the vergence of the axial beam at ideal lenses, and the ray along the axis, which
tells from which side light comes behind coordinate breaks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.optics.bent_paraxial import BentGap, paraxial_gaps
from dolens.optics.elements import LENS_AXES, change_axes
from dolens.optics.gradients import Profile
from dolens.optics.materials import Medium, is_anisotropic
from dolens.optics.paraxial import (
    TwoRays,
    behind_surfaces,
    curvatures_of,
    deflects,
    matrix_to_stop,
    powers_of,
    ratio,
    through_surfaces,
    vergence,
)
from dolens.optics.rays import Components
from dolens.optics.surfaces.deflection import Media, Travel
from dolens.optics.surfaces.ideal_lens import IdealLens
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.system import OpticalSystem, per_radian


class ParaxialRay(NamedTuple):
    """A paraxial ray at every surface; each (surfaces,).

    Attributes:
        height: on the vertex plane, mm.
        slope_before: dy/dz in the medium before the surface.
        slope_after: dy/dz in the medium behind it.
    """

    height: Tensor
    slope_before: Tensor
    slope_after: Tensor


class ParaxialRays(NamedTuple):
    """The two rays that first-order optics is made of, and what they keep.

    Attributes:
        marginal: from the axial object point to the edge of the stop.
        chief: from the edge of the field to the centre of the stop.
        lagrange_invariant: H = n(u·ȳ - ū·y), mm, the same before and behind every surface (y, u of
            the marginal ray, ȳ, ū of the chief ray).  With the object at infinity -n·y·tan(field).
    """

    marginal: ParaxialRay
    chief: ParaxialRay
    lagrange_invariant: Tensor


def field_tangent(
    field: float | Tensor, object_distance: float | Tensor | None, like: Tensor
) -> Tensor:
    """Slope of the line from the object point to the first vertex.

    Args:
        field: angle in radians for an object at infinity; else the height of the object in mm.
        object_distance: mm in front of the first vertex, or None.
        like: whose precision and device the result has.
    """
    field = torch.as_tensor(field, dtype=like.dtype, device=like.device)
    near = torch.as_tensor(vergence(object_distance), dtype=like.dtype, device=like.device)
    # No branch on the value: a tensor of distances may hold an infinite one.
    return torch.where(near == 0.0, torch.tan(field), -field * near)


def paraxial_rays(
    system: OpticalSystem,
    wavelength: float | Tensor,
    field: float | Tensor,
    object_distance: float | Tensor | None = None,
) -> ParaxialRays:
    """Trace the marginal and the chief ray through every surface.

    The marginal ray has a positive height on surface 1; it meets the edge of the stop, whose
    semi-diameter is the aperture.

    Args:
        system: the lens.
        wavelength: nm.
        field: radians, the chief ray's slope being tan(field), for an object at infinity; else the
            height of the object point in mm, from which the chief ray comes down.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
    """
    matrix = matrix_to_stop(system, wavelength)
    a, b = matrix[0, 0], matrix[0, 1]
    n = system.signed_indices(wavelength)
    near = vergence(object_distance)
    tangent = field_tangent(field, object_distance, matrix)
    at_stop = a + b * (n[0] * near)
    radius = torch.full_like(at_stop, system.surfaces[system.stop - 1].semi_diameter)
    y = ratio(radius, at_stop.abs())
    # The chief ray's height -bnT/(a + bn/d) and slope aT/(a + bn/d) meet the axis at the stop,
    # a·y + b·n·u = 0, and the object point, y - d·u = -d·T.
    chief_y, chief_u = ratio(-b * n[0] * tangent, at_stop), ratio(a * tangent, at_stop)

    start = TwoRays(y, chief_y, n[0] * (y * near), n[0] * chief_u)
    powers, gaps = powers_of(system, wavelength), system.paraxial_gaps(wavelength)
    behind = list(through_surfaces(start, curvatures_of(system), gaps, n, powers))
    arriving, fronts = [start], [n[0]]
    for rays, gap, index in zip(behind, gaps, n[1:], strict=False):
        arriving.append(rays.transferred(gap, index))
        fronts.append(gap.behind if isinstance(gap, BentGap) else index)
    marginal = ParaxialRay(
        torch.stack([s.y for s in behind]),
        _slopes([s.nu for s in arriving], fronts),
        _slopes([s.nu for s in behind], n[1:]),
    )
    chief = ParaxialRay(
        torch.stack([s.y2 for s in behind]),
        _slopes([s.nu2 for s in arriving], fronts),
        _slopes([s.nu2 for s in behind], n[1:]),
    )
    invariant = start.nu * chief_y - start.nu2 * y
    return ParaxialRays(marginal, chief, invariant)


def _slopes(reduced: list[Tensor], indices: Sequence[float | Tensor]) -> Tensor:
    """Return slopes at all surfaces of reduced ones in media of these indices."""
    return torch.stack([nu / n for nu, n in zip(reduced, indices, strict=True)])


Number = Any  # of Python's, or a tensor


@dataclass(frozen=True)
class ParaxialNumbers:
    """A centred lens as first-order optics sees it.

    Python's own arithmetic takes a hundredth of the time that tensors of one number take, and on a
    GPU one transfer in place of many.  `differentiable` holds tensors in the same places.

    Attributes:
        curvatures: paraxial, of each surface, 1/mm.
        thicknesses: between neighbouring vertices, mm.
        sensor_distance: from the last vertex, mm.
        materials: before surface 1 and after each surface.
        stop: number of the stop surface, from 1.
        stop_radius: mm.
        senses: +1 where light travels towards +z, -1 towards -z; of each medium.
        powers: what each surface adds to the power of refraction, a constant (1/mm) and a
            coefficient of the wavelength (1/(mm nm)); None where none adds any.
        offsets: added to the index of each medium; () where nothing is.
        gradients: places of gradients, the surfaces that their profiles count from, and these.
    """

    curvatures: tuple[Number, ...]
    thicknesses: tuple[Number, ...]
    sensor_distance: Number
    materials: tuple[Medium, ...]
    stop: int
    stop_radius: Number
    senses: tuple[float, ...]
    powers: tuple[tuple[Number, Number], ...] | None = None
    offsets: tuple[Number, ...] = ()
    gradients: tuple[tuple[int, tuple[int, Profile]], ...] = ()

    @classmethod
    @torch.no_grad()
    def of(cls, system: OpticalSystem) -> "ParaxialNumbers":
        """The numbers of a lens."""
        curvatures, powers, offsets = curvatures_of(system), _powers(system), _offsets(system)
        scalars = [*curvatures, *system.thicknesses, system.sensor_distance, *powers, *offsets]
        scalars += _coefficients(system)
        numbers = torch.stack(
            [torch.as_tensor(s, dtype=torch.float64, device=system.device) for s in scalars]
        ).tolist()
        radius = float(system.surfaces[system.stop - 1].semi_diameter)
        return cls._of_numbers(system, numbers, radius, len(powers))

    @classmethod
    def differentiable(cls, system: OpticalSystem) -> "ParaxialNumbers | None":
        """The same numbers as tensors, in double precision on the CPU; None where no gradient
        would come of them.
        """
        curvatures, powers, offsets = curvatures_of(system), _powers(system), _offsets(system)
        radius = system.surfaces[system.stop - 1].edge_radius
        lengths = [*system.thicknesses, system.sensor_distance]
        scalars = [*curvatures, *lengths, *powers, *offsets, *_coefficients(system), radius]
        if not any(isinstance(s, Tensor) and s.requires_grad for s in scalars):
            return None
        *numbers, edge = (torch.as_tensor(s, dtype=torch.float64).cpu() for s in scalars)
        return cls._of_numbers(system, numbers, edge, len(powers))

    @classmethod
    def _of_numbers(
        cls, system: OpticalSystem, numbers: Sequence[Any], radius: Any, powers: int
    ) -> "ParaxialNumbers":
        """Take apart curvatures, gaps, the sensor's distance, powers, offsets and coefficients of
        gradients, in this order.
        """
        count = len(system.surfaces)
        place = 2 * count + powers
        offsets = tuple(numbers[place : place + len(system.index_offsets)])
        rest, gradients = iter(numbers[place + len(offsets) :]), []
        for k, origin in system.gradients.items():
            profile = system.profile(k)
            own = replace(profile, values=tuple(next(rest) for _ in profile.values))
            gradients.append((k, (origin, own)))
        return cls(
            tuple(numbers[:count]),
            tuple(numbers[count : 2 * count - 1]),
            numbers[2 * count - 1],
            tuple(system.materials),
            system.stop,
            radius,
            system.senses,
            _pairs(numbers[2 * count : 2 * count + powers]),
            offsets,
            tuple(gradients),
        )

    @property
    def length(self) -> Number:
        """From the first vertex to the last, mm."""
        return sum(self.thicknesses)

    def exit_pupil(self, wavelength: float) -> tuple[Number, Number]:
        """z from the first vertex and diameter, mm; both infinite where it lies at infinity."""
        _, b, _, d = self._unit_rays_behind(wavelength, self.stop, len(self.curvatures))
        if d == 0.0:
            return float("inf"), float("inf")
        image_index = self._index(-1, wavelength)
        return self.length - b * image_index / d, 2.0 * self.stop_radius / abs(d)

    def chief_ray_magnification(self, wavelength: float, depth: float) -> Number:
        """Height on the sensor over height on an object at a depth in mm, by the chief ray."""
        before, behind = self._index(0, wavelength), self._index(-1, wavelength)
        a, b, _, _ = self._unit_rays_at_stop(wavelength)
        # The chief ray heads for the entrance pupil at z = n b/a: from height 1 at -depth.
        slope = -a / (b * before + depth * a)
        height = 1.0 + slope * depth
        a, b, c, d = self._unit_rays_behind(wavelength, 1, len(self.curvatures))
        reduced = before * slope
        return a * height + b * reduced + (c * height + d * reduced) / behind * self.sensor_distance

    def _unit_rays_at_stop(self, wavelength: float) -> TwoRays:
        """Trace the unit rays from before the first vertex to just before the stop."""
        rays = self._unit_rays_behind(wavelength, 1, self.stop - 1)
        if self.stop == 1:
            return rays
        index = self._index(self.stop - 1, wavelength)
        return rays.transferred(self._gaps(wavelength)[self.stop - 2], index)

    def _unit_rays_behind(self, wavelength: float, first: int, last: int) -> TwoRays:
        """Trace the unit rays from just before surface `first` to just after `last`."""
        powers, curvatures = None, self.curvatures[first - 1 : last]
        if self.powers is not None:
            powers = [constant + k * wavelength for constant, k in self.powers[first - 1 : last]]
        media = range(first - 1, last + 1)
        shifts = [self._shift(medium, wavelength) for medium in media]
        if any(shifts):
            steps = (b - a for a, b in pairwise(shifts))
            own = powers or [0.0] * len(curvatures)
            powers = [p + s * c for p, s, c in zip(own, steps, curvatures, strict=True)]
        return behind_surfaces(
            curvatures,
            self._gaps(wavelength)[first - 1 : max(last - 1, 0)],
            [self._index(medium, wavelength) for medium in media],
            powers,
        )

    def _shift(self, medium: int, wavelength: float) -> float:
        """Return how much larger a crystal's index is at its faces; see `powers_of`."""
        crystal: Any = self.materials[medium]
        if not is_anisotropic(crystal):
            return 0.0
        difference = crystal.axial_index(wavelength) - crystal.index(wavelength)
        return self.senses[medium] * float(difference)

    def _gaps(self, wavelength: float) -> Sequence[Number | BentGap]:
        """Return the gaps as paraxial rays take them."""
        if not self.gradients:
            return self.thicknesses
        indices = [self._index(place, wavelength) for place, _ in self.gradients]
        profiles = {}
        for place, (origin, profile) in self.gradients:
            medium: Any = self.materials[place]
            profiles[place] = origin, medium.profile_at(profile, wavelength)
        return paraxial_gaps(self.thicknesses, profiles, indices, self.senses)

    def _index(self, medium: int, wavelength: float) -> Number:
        """Return a medium's index, negative where light travels towards -z."""
        index: Number = float(self.materials[medium].index(wavelength))
        if self.offsets:
            index = index + self.offsets[medium]
        return self.senses[medium] * index


def _offsets(system: OpticalSystem) -> list[Number]:
    """Return what is added to the index of each medium; nothing without any."""
    return [0.0 if offset is None else offset for offset in system.index_offsets]


def _coefficients(system: OpticalSystem) -> list[Number]:
    """Return the coefficients of all gradients."""
    return [value for place in system.gradients for value in system.profile(place).values]


def _powers(system: OpticalSystem) -> list[Number]:
    """Return constant and coefficient of every surface's added power; nothing without any."""
    if not deflects(system.surfaces):
        return []
    found: list[Number] = []
    for surface in system.surfaces:
        law = surface.deflection
        found += (0.0, 0.0) if law is None else law.law.paraxial_power(law.parameters)
    return found


def _pairs(numbers: Sequence[Number]) -> tuple[tuple[Number, Number], ...] | None:
    """Pair numbers that follow each other; None where there are none."""
    return tuple(zip(numbers[::2], numbers[1::2], strict=True)) or None


# Light that meets a lens in its focus has no finite vergence there, 1/mm.
_LARGEST = 1e9


def ideal_lenses(system: OpticalSystem) -> list[int]:
    """Return the places of ideal lenses among the surfaces, from 0."""
    laws = [surface.deflection for surface in system.surfaces]
    return [i for i, law in enumerate(laws) if law is not None and law.law is IdealLens]


def with_vergences(system: OpticalSystem, wavelength: float, near: float | Tensor) -> OpticalSystem:
    """Return the system with the reduced vergence of the axial beam at each of its ideal lenses.

    Vergences are functions of the lens in front, and have its gradients.  Where the axial beam is
    focused on an ideal lens (a field lens), its vergence is held at 1e9/mm: the lens then changes
    the beam's path by rounding only.  A cusp (an axicon's), which has no paraxial curvature, counts
    as a plane.

    Args:
        system: the lens; itself where it has no ideal lens.
        wavelength: nm, of the paraxial axial ray.
        near: one over the object's distance in front of the first vertex, 1/mm; zero at infinity.
            A tensor of several is for rays that broadcast with it, traced by the reference.
    """
    lenses = ideal_lenses(system)
    if not lenses:
        return system
    index = system.signed_indices(wavelength)
    near = torch.as_tensor(near, dtype=system.dtype, device=system.device)
    one = torch.ones_like(near)
    ray = TwoRays(one, 0.0 * one, index[0] * near, 0.0 * one)
    curvatures = [_or_plane(curvature) for curvature in curvatures_of(system)]
    gaps, powers = system.paraxial_gaps(wavelength), powers_of(system, wavelength)
    behind = list(through_surfaces(ray, curvatures, gaps, index, powers))
    surfaces = list(system.surfaces)
    for i in lenses:
        reduced = behind[i - 1].nu if i else ray.nu
        height = behind[i].y
        focused = height == 0.0
        arriving = (reduced / torch.where(focused, one, height)).clamp(-_LARGEST, _LARGEST)
        arriving = torch.where(focused, torch.full_like(one, _LARGEST), arriving)
        law = surfaces[i].deflection
        assert law is not None  # an ideal lens is a law
        own = {**law.parameters, "vergence": arriving.to(system.dtype)}
        surfaces[i] = replace(surfaces[i], deflection=replace(law, parameters=own))
    found = replace(system, surfaces=surfaces)
    return found.traced_by("reference") if near.numel() > 1 else found


def _or_plane(curvature: Tensor | float) -> Tensor | float:
    """Return a curvature (1/mm), or zero where there is none."""
    if not isinstance(curvature, Tensor):
        return curvature
    return torch.where(curvature.isnan(), torch.zeros_like(curvature), curvature)


# A ray whose cosine to the axis is smaller does not say from which side it comes.
_ALONG = 1e-9


@torch.no_grad()
def reversals(system: OpticalSystem, wavelength: float) -> tuple[int, ...]:
    """Find the breaks that turn the axes so far that light goes the other way along z behind them.

    A ray starts along the axis of the first row and is traced through every surface, whatever its
    aperture.  Where it misses one it goes on as at a plane through the vertex.  It travels towards
    +z or -z of the axes that it comes to, and where that is not what the mirrors before say, the
    last break in between has turned it.

    Args:
        system: the lens; its own reversals do not count.
        wavelength: nm.

    Returns:
        Numbers of breaks.
    """
    if not system.breaks:
        return ()
    system = replace(system.double(), reversals=())
    indices, axes = system.indices(wavelength), system.all_axes
    zero = torch.zeros((), dtype=torch.float64, device=system.device)
    ray, here, sense = Components(zero, zero, zero, zero, zero, zero + 1.0), LENS_AXES, 1.0
    found, last_break = [], None
    for number, place in enumerate(axes, 1):
        at_sensor = number > len(system.surfaces)
        if number in system.breaks:
            last_break = number
            continue
        ray, _ = change_axes(ray, here, place)
        here, n = place, float(ray.n)
        if last_break is not None and sense * n < -_ALONG:
            sense = -sense
            found.append(last_break)
        last_break = None
        if at_sensor:
            break
        leaving = -sense if number in system.mirrors else sense
        if abs(n) > _ALONG:
            ray = _through(system, number, ray, sense, leaving, indices, wavelength)
        sense = leaving
    return tuple(found)


def _through(
    system: OpticalSystem,
    number: int,
    ray: Components,
    sense: float,
    leaving: float,
    indices: list[float | torch.Tensor],
    wavelength: float,
) -> Components:
    """Return a ray behind a surface, in its axes."""
    surface = system.surfaces[number - 1]
    x, y, z, *direction = ray
    l, m, n = direction  # noqa: E741
    x, y = x - z / n * l, y - z / n * m
    p, size = surface.parameters, surface.semi_diameter
    t, met = surface.shape.intersect(p, PlaneRay(x, y, l, m, n), sense, size)
    point = (x + t * l, y + t * m, t * n)
    behind = Components(*point, *direction)
    if surface.deflection is not None:
        before, after = indices[number - 1], indices[number]
        media = Media(before, after, per_radian(wavelength, n))
        *bent, transmitted, _ = surface.deflect(
            point, (l, m, n), media, Travel(sense, leaving, True)
        )
        behind = Components(*point, *bent)
        if transmitted is not None:
            met = transmitted if met is None else torch.minimum(met, transmitted)
    elif system.refracts(number):
        ratio = indices[number - 1] / indices[number]
        *bent, transmitted = surface.shape.refract(p, point, (l, m, n), ratio, leaving)
        behind = Components(*point, *bent)
        met = transmitted if met is None else torch.minimum(met, transmitted)
    finite = all(bool(torch.isfinite(c)) for c in behind)
    if finite and (met is None or bool(met > 0.0)):
        return behind
    flat = n.abs() * leaving
    return Components(x, y, torch.zeros_like(x), l, m, flat)
