"""A lens as pure functions see it: tensors and names, no state."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from dolens.optics.elements import Axes, ElementState, surface_axes
from dolens.optics.materials import Medium
from dolens.optics.surfaces.state import SurfaceState


def per_radian(wavelength: float | Tensor, like: Tensor) -> float | Tensor:
    """Return λ/2π in mm, the path in vacuum of one radian, of a wavelength in nm.

    A tensor of wavelengths gives one in the precision of `like`, and on its device.
    """
    length = wavelength * (1e-6 / (2.0 * math.pi))
    return length.to(like) if isinstance(length, Tensor) else length


@dataclass(frozen=True)
class OpticalSystem:
    """A sequence of surfaces and a sensor plane, centred but for the poses of its elements.

    Attributes:
        surfaces: in the order that light meets them.
        thicknesses: gaps between neighbouring vertices, mm, one fewer than surfaces.
        sensor_distance: from the last vertex to the sensor plane, mm.
        materials: before surface 1 and after each surface.
        stop: number of the stop surface, from 1.
        elements: groups of surfaces with a pose of their own.
        backend: the implementation that traces rays through it: `reference`, `cpu`, `cuda`, or
            `auto`; see `dolens.optics.backend.choose_backend`.
    """

    surfaces: Sequence[SurfaceState]
    thicknesses: Sequence[Tensor]
    sensor_distance: Tensor
    materials: Sequence[Medium]
    stop: int
    elements: Sequence[ElementState] = ()
    backend: str = "auto"

    def indices(self, wavelength: float | Tensor) -> list[float | Tensor]:
        """Indices before surface 1 and after each surface, at a wavelength in nm.

        A tensor of wavelengths gives tensors in the lens's precision, so that the wavelengths'
        own does not decide in which precision rays are traced.
        """
        if isinstance(wavelength, Tensor):
            finer = torch.promote_types(wavelength.dtype, self.dtype)
            wavelength = wavelength.to(device=self.device, dtype=finer)
        # Each medium once: air comes between all the others.
        indices = {medium: medium.index(wavelength) for medium in dict.fromkeys(self.materials)}
        ordered = [indices[medium] for medium in self.materials]
        return [n.to(self.dtype) if isinstance(n, Tensor) else n for n in ordered]

    @property
    def vertices(self) -> list[Tensor]:
        """z of every vertex as designed, then of the sensor, in mm; the first is at 0."""
        positions = [torch.zeros_like(self.sensor_distance)]
        for gap in (*self.thicknesses, self.sensor_distance):
            positions.append(positions[-1] + gap)
        return positions

    @property
    def axes(self) -> list[Axes]:
        """The axes of every surface, with the poses of the elements that carry it."""
        return surface_axes(self.elements, self.vertices, len(self.surfaces))

    @property
    def dtype(self) -> torch.dtype:
        """The precision that rays are traced in."""
        return self.sensor_distance.dtype

    @property
    def device(self) -> torch.device:
        """The device that the lens lives on."""
        return self.sensor_distance.device

    @cached_property
    def rotationally_symmetric(self) -> bool:
        """Return whether nothing in the lens singles out a direction across the axis."""
        surfaces = all(s.shape.rotational and s.aperture.rotational for s in self.surfaces)
        laws = all(s.deflection is None or s.deflection.law.rotational for s in self.surfaces)
        return surfaces and laws and not self.elements

    def traced_by(self, backend: str) -> "OpticalSystem":
        """The same lens, traced by another implementation."""
        return replace(self, backend=backend)

    def double(self) -> "OpticalSystem":
        """The same lens in double precision; gradients flow back to its own tensors."""
        return replace(
            self,
            surfaces=[s.double() for s in self.surfaces],
            thicknesses=[gap.double() for gap in self.thicknesses],
            sensor_distance=self.sensor_distance.double(),
            elements=[
                replace(e, parameters={n: p.double() for n, p in e.parameters.items()})
                for e in self.elements
            ],
        )

    def opened(self) -> "OpticalSystem":
        """The same lens with apertures that clip nothing."""
        return replace(
            self, surfaces=[replace(s, aperture=s.aperture.opened()) for s in self.surfaces]
        )
