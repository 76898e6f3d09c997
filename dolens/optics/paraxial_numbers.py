"""First-order optics in scalar arithmetic: plain numbers, or tensors where gradients are wanted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.optics.materials import Medium
from dolens.optics.paraxial_recurrence import TwoRays, behind_surfaces
from dolens.optics.paraxial_surfaces import curvatures_of, deflects
from dolens.optics.system import OpticalSystem

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

    @classmethod
    @torch.no_grad()
    def of(cls, system: OpticalSystem) -> "ParaxialNumbers":
        """The numbers of a lens."""
        curvatures, powers, offsets = curvatures_of(system), _powers(system), _offsets(system)
        scalars = [*curvatures, *system.thicknesses, system.sensor_distance, *powers, *offsets]
        numbers = torch.stack(
            [torch.as_tensor(s, dtype=torch.float64, device=system.device) for s in scalars]
        ).tolist()
        count = len(curvatures)
        return cls(
            tuple(numbers[:count]),
            tuple(numbers[count : 2 * count - 1]),
            numbers[2 * count - 1],
            tuple(system.materials),
            system.stop,
            float(system.surfaces[system.stop - 1].semi_diameter),
            system.senses,
            _pairs(numbers[2 * count : 2 * count + len(powers)]),
            tuple(numbers[2 * count + len(powers) :]),
        )

    @classmethod
    def differentiable(cls, system: OpticalSystem) -> "ParaxialNumbers | None":
        """The same numbers as tensors, in double precision on the CPU; None where no gradient
        would come of them.
        """
        curvatures, powers, offsets = curvatures_of(system), _powers(system), _offsets(system)
        radius = system.surfaces[system.stop - 1].edge_radius
        lengths = [*system.thicknesses, system.sensor_distance, radius]
        scalars = [*curvatures, *lengths, *powers, *offsets]
        if not any(isinstance(s, Tensor) and s.requires_grad for s in scalars):
            return None
        numbers = [torch.as_tensor(s, dtype=torch.float64).cpu() for s in scalars]
        count = len(curvatures)
        return cls(
            tuple(numbers[:count]),
            tuple(numbers[count : 2 * count - 1]),
            numbers[2 * count - 1],
            tuple(system.materials),
            system.stop,
            numbers[2 * count],
            system.senses,
            _pairs(numbers[2 * count + 1 : 2 * count + 1 + len(powers)]),
            tuple(numbers[2 * count + 1 + len(powers) :]),
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
        return rays.transferred(self.thicknesses[self.stop - 2], index)

    def _unit_rays_behind(self, wavelength: float, first: int, last: int) -> TwoRays:
        """Trace the unit rays from just before surface `first` to just after `last`."""
        powers = None
        if self.powers is not None:
            powers = [constant + k * wavelength for constant, k in self.powers[first - 1 : last]]
        return behind_surfaces(
            self.curvatures[first - 1 : last],
            self.thicknesses[first - 1 : max(last - 1, 0)],
            [self._index(medium, wavelength) for medium in range(first - 1, last + 1)],
            powers,
        )

    def _index(self, medium: int, wavelength: float) -> Number:
        """Return a medium's index, negative where light travels towards -z."""
        index: Number = float(self.materials[medium].index(wavelength))
        if self.offsets:
            index = index + self.offsets[medium]
        return self.senses[medium] * index


def _offsets(system: OpticalSystem) -> list[Number]:
    """Return what is added to the index of each medium; nothing without any."""
    return [0.0 if offset is None else offset for offset in system.index_offsets]


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
