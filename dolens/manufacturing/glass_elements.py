"""The glass elements of a lens: which surfaces bound each, where they lie, and what their edge is.

An element reaches to the larger clear semi-diameter of its two surfaces.  The surface with the
smaller one is followed by a flat ring, across the element's axis, out to the edge; where that flat
would cut the other surface, the edge is a cone between the two rims.  A surface without an axis of
symmetry goes on as its own sag to the edge.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.materials import Medium, is_glass
from dolens.optics.surfaces.base import Parameters, Surface
from dolens.optics.surfaces.clear_aperture import ClearAperture, Rectangle
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem, require_refracting

# Lengths that differ by less than this (mm) are the same to a workshop and to a solid modeller.
SAME_LENGTH = 1e-6
# Radii and azimuths at which the glass between two surfaces is measured.
_RADII = 401
_AZIMUTHS = 48


@dataclass(frozen=True)
class Face:
    """One surface of an element, in double precision.

    Attributes:
        number: of the surface in the lens, from 1.
        surface: its parameters without gradients, on the CPU.
        rotation: (3, 3); a point p in the surface's axes lies at origin + rotation·p in the lens's.
        origin: (3,), mm, the vertex.
    """

    number: int
    surface: SurfaceState
    rotation: np.ndarray
    origin: np.ndarray

    @property
    def shape(self) -> type[Surface]:
        """Return the class of the surface, a namespace of pure functions."""
        return self.surface.shape

    @property
    def parameters(self) -> Parameters:
        """Return the parameters of the surface by name."""
        return self.surface.parameters

    @property
    def aperture(self) -> ClearAperture:
        """Return what light passes."""
        return self.surface.aperture

    @property
    def semi_diameter(self) -> float:
        """Return the distance of the clear aperture's farthest point from the vertex, mm."""
        return self.aperture.edge.semi_diameter

    @property
    def flat(self) -> bool:
        """Return whether the surface is a plane, or a sphere of no curvature."""
        numbers = self.parameters.values()
        return self.shape.rotational and all(not bool((p != 0.0).any()) for p in numbers)

    def sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the sag (mm) at points (mm) in the surface's axes; NaN where it has none."""
        sag, _, _, exists = self.sag_and_slopes(x, y)
        return np.where(exists, sag, np.nan)

    def sag_and_slopes(
        self, x: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the sag (mm), its slopes, and whether the sag branch exists; all are finite."""
        points = (torch.as_tensor(v, dtype=torch.float64) for v in np.broadcast_arrays(x, y))
        sag, sx, sy, exists = self.surface.sag_and_slopes(*points)
        return sag.numpy(), sx.numpy(), sy.numpy(), exists.numpy()

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return z (mm) of the ground face: the sag, and the flat ring beyond the semi-diameter."""
        if not self.shape.rotational:
            return self.sag(x, y)
        r = np.minimum(np.hypot(x, y), self.semi_diameter)
        return self.sag(r, np.zeros_like(r))

    def to_lens(self, points: np.ndarray) -> np.ndarray:
        """Return points (..., 3) of the surface's axes in the lens's, mm."""
        return points @ self.rotation.T + self.origin

    def from_lens(self, points: np.ndarray) -> np.ndarray:
        """Return points (..., 3) of the lens's axes in the surface's, mm."""
        return (points - self.origin) @ self.rotation


@dataclass(frozen=True)
class GlassElement:
    """A piece of glass between two neighbouring surfaces.

    Attributes:
        name: `E1`, `E2`, … in the order of the light.
        label: the name of the lens's own element that holds both surfaces, or nothing.
        front: the surface that light enters.
        back: the surface that light leaves.
        material: of the glass.
        cemented: whether glass follows behind the back, or lies before the front, without air.
    """

    name: str
    label: str
    front: Face
    back: Face
    material: Medium
    cemented: tuple[bool, bool]

    @property
    def title(self) -> str:
        """Return name, label and surfaces, as messages and products of a STEP file show them."""
        label = f" {self.label}" if self.label else ""
        return f"{self.name}{label} (surfaces {self.front.number}-{self.back.number})"

    @property
    def semi_diameter(self) -> float:
        """Return the radius of the edge (mm): the larger of the two clear semi-diameters."""
        return max(self.front.semi_diameter, self.back.semi_diameter)

    @property
    def half_widths(self) -> tuple[float, float] | None:
        """Return the half widths (mm) of an element with two rectangular faces, else None."""
        edges = (self.front.aperture.edge, self.back.aperture.edge)
        if not all(isinstance(edge, Rectangle) for edge in edges):
            return None
        x, y = zip(*(edge.extent for edge in edges), strict=True)
        return max(x), max(y)

    @cached_property
    def aligned(self) -> bool:
        """Return whether the two surfaces share one axis."""
        step = self.front.from_lens(self.back.origin)
        turn = self.front.rotation.T @ self.back.rotation
        return bool(np.abs(turn - np.eye(3)).max() < 1e-13 and np.abs(step[:2]).max() < 1e-10)

    @property
    def rotational(self) -> bool:
        """Return whether the element is a body of revolution."""
        faces = (self.front, self.back)
        shapes = all(face.shape.rotational for face in faces)
        return shapes and self.aligned and self.half_widths is None

    @property
    def centre_thickness(self) -> float:
        """Return the distance between the vertices along the front's axis, mm."""
        return float(self.front.from_lens(self.back.origin)[2])

    @cached_property
    def conical_edge(self) -> bool:
        """Return whether the edge is a cone between the rims, as a flat would cut the glass."""
        a, b = self.front.semi_diameter, self.back.semi_diameter
        if not self.rotational or abs(a - b) < SAME_LENGTH:
            return False
        r = np.linspace(min(a, b), max(a, b), _RADII)
        return bool(np.min(self.thickness(r, np.zeros_like(r))) <= SAME_LENGTH)

    @property
    def edge_thickness(self) -> float:
        """Return the least length of the edge along the axis, mm; 0 where two faces meet."""
        if self.conical_edge:
            return 0.0
        angle = np.linspace(0.0, 2.0 * np.pi, 4 * _AZIMUTHS, endpoint=False)
        x, y = self.rim(angle)
        return float(np.nanmin(self.thickness(x, y)))

    def rim(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (mm) of the edge at azimuths (radians)."""
        cosine, sine = np.cos(angle), np.sin(angle)
        if self.half_widths is None:
            return self.semi_diameter * cosine, self.semi_diameter * sine
        hx, hy = self.half_widths
        reach = 1.0 / np.maximum(np.abs(cosine) / hx, np.abs(sine) / hy)
        return reach * cosine, reach * sine

    def thickness(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the glass (mm) between the faces along the front's axis.

        Args:
            x: mm, in the axes of the back, of which points are taken.
            y: mm.

        Returns:
            z of these points in the front's axes, less the front's own z there; NaN where either
            surface has no sag.
        """
        points = np.stack(np.broadcast_arrays(x, y, self.back.height(x, y)), -1)
        seen = self.front.from_lens(self.back.to_lens(points))
        return seen[..., 2] - self.front.height(seen[..., 0], seen[..., 1])

    def fault(self) -> str | None:
        """Return why there is no such piece of glass, in one sentence, or None."""
        share = np.linspace(0.0, 1.0, _RADII)[:, None]
        x, y = self.rim(np.arange(_AZIMUTHS) * (2.0 * np.pi / _AZIMUTHS))
        gap = self.thickness(share * x, share * y)
        if self.conical_edge:
            inner = min(self.front.semi_diameter, self.back.semi_diameter)
            gap = gap[share[:, 0] * self.semi_diameter <= inner]
        if np.isnan(gap).any():
            return (
                f"{self.title}: a surface has no sag out to the edge at "
                f"{self.semi_diameter:g} mm from the axis"
            )
        row, column = np.unravel_index(np.argmin(gap), gap.shape)
        if gap[row, column] <= SAME_LENGTH:
            r = float(share[row, 0] * np.hypot(x[column], y[column]))
            return (
                f"{self.title}: its surfaces cross inside the aperture; the glass is "
                f"{gap[row, column]:.3g} mm thick at {r:.4g} mm from the axis"
            )
        return None if not self.conical_edge else self._fault_of_cone()

    def _fault_of_cone(self) -> str | None:
        outer, inner = sorted((self.front, self.back), key=lambda f: -f.semi_diameter)
        share = np.linspace(0.0, 1.0, _RADII)[:-1]
        r = inner.semi_diameter + share * (outer.semi_diameter - inner.semi_diameter)
        zero = np.zeros(1)
        step = self.centre_thickness if outer is self.front else -self.centre_thickness
        start = step + inner.height(np.full(1, inner.semi_diameter), zero)
        end = outer.height(np.full(1, outer.semi_diameter), zero)
        gap = (start + share * (end - start)) - outer.height(r, np.zeros_like(r))
        if (gap if outer is self.front else -gap).min() > 0.0:
            return None
        return (
            f"{self.title}: surface {outer.number} cuts the edge between the rims at "
            f"{inner.semi_diameter:g} and {outer.semi_diameter:g} mm"
        )


def glass_elements(lens: Lens) -> list[GlassElement]:
    """Return the pieces of glass of a lens, in the order of the light.

    Every gap that is neither air nor occluder is one; cemented ones share a surface.

    Raises:
        InputError: the lens has no glass, or mirrors or coordinate breaks.
    """
    system = lens.system().double()
    require_refracting(system, f"lens '{lens.name}': drawings and solids")
    groups = {(e.first, e.last): name for name, e in lens.elements.items()}
    faces = {number: face_of(system, number) for number in range(1, len(system.surfaces) + 1)}
    inside = [
        number for number in range(1, len(system.surfaces)) if is_glass(system.materials[number])
    ]
    if not inside:
        raise InputError(f"lens '{lens.name}' has no glass between its surfaces")
    return [
        GlassElement(
            f"E{count}",
            _label(groups, number),
            faces[number],
            faces[number + 1],
            system.materials[number],
            (number - 1 in inside, number + 1 in inside),
        )
        for count, number in enumerate(inside, 1)
    ]


def face_of(system: OpticalSystem, number: int) -> Face:
    """Return a surface of a system as a face, in double precision and where it lies."""
    surface = system.surfaces[number - 1]
    rotation, origin = (part.numpy() for part in system.place(number))
    parameters = {name: p.detach().double().cpu() for name, p in surface.parameters.items()}
    return Face(number, replace(surface, parameters=parameters), rotation, origin)


def _label(groups: Mapping[tuple[int, int], str], number: int) -> str:
    """Return the name of the smallest element of the lens that holds a gap's two surfaces."""
    holding = [span for span in groups if span[0] <= number and number + 1 <= span[1]]
    return groups[min(holding, key=lambda span: span[1] - span[0])] if holding else ""
