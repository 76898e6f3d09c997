"""A surface as the pure functions see it."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.optics.coatings import CoatingState
from dolens.optics.diffractive import Relief
from dolens.optics.metasurface import Cells
from dolens.optics.surfaces.base import Parameters, Surface
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.deflection import Deflected, Law, Media, Travel, Vector


@dataclass(frozen=True)
class LawState:
    """The pure functions see what deflects light at a surface in this form.

    Attributes:
        law: the `Law` subclass, used as a namespace of pure functions.
        parameters: name → tensor.
    """

    law: type[Law]
    parameters: Parameters


@dataclass(frozen=True)
class SurfaceState:
    """The pure functions see a surface in this form.

    Attributes:
        shape: the `Surface` subclass, used as a namespace of pure functions.
        parameters: name → tensor.
        aperture: what light passes.
        edge: the semi-diameter as a tensor, where a gradient with respect to it is wanted.
        deflection: what deflects light in the place of Snell's law, or None.
        coating: what decides which share of the light passes, or None: all of it.
        relief: of a diffractive element, or its cells, or None; rays do not see it.
    """

    shape: type[Surface]
    parameters: Parameters
    aperture: ClearAperture
    edge: Tensor | None = None
    deflection: LawState | None = None
    coating: CoatingState | None = None
    relief: Relief | Cells | None = None

    def deflect(self, point: Vector, direction: Vector, media: Media, travel: Travel) -> Deflected:
        """Deflect rays at points (mm) of the surface by its law; see `Law.deflect`."""
        normal = self.shape.normal(self.parameters, *point)
        law = self.deflection
        assert law is not None  # Snell's is not among them
        return law.law.deflect(law.parameters, point, direction, normal, media, travel)

    def cosine_of_incidence(self, point: Vector, direction: Vector) -> Tensor:
        """Return the cosine of the angle between rays and the normal at points (mm), 0 to 1."""
        normal = self.shape.normal(self.parameters, *point)
        along = sum(d * n for d, n in zip(direction, normal, strict=True))
        return torch.as_tensor(along).abs().clamp(max=1.0)

    def double(self) -> "SurfaceState":
        """Return the same surface in double precision; gradients flow back to its own tensors."""
        law = self.deflection
        if law is not None:
            law = replace(law, parameters={n: p.double() for n, p in law.parameters.items()})
        parameters = {n: p.double() for n, p in self.parameters.items()}
        relief = self.relief
        if relief is not None:
            relief = relief.with_values([value.double() for value in relief.values])
        return replace(self, parameters=parameters, deflection=law, relief=relief)

    def sag_and_slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the sag (mm) at points (mm), its slopes along x and y, and bool, where its branch
        exists; in double precision on the CPU, all finite and without gradients.
        """
        parameters = {name: p.detach().double().cpu() for name, p in self.parameters.items()}
        sag, sx, sy, margin = self.shape.sag_and_gradient(parameters, x, y)
        # The rim of a whole hemisphere is on the branch, and its margin has rounded.
        exists = torch.ones_like(sag, dtype=torch.bool) if margin is None else margin >= -1e-12
        return sag, sx, sy, exists

    def rim_sag(self, like: Tensor) -> Tensor:
        """Return the sag (mm) at the aperture's reach along x, in another tensor's precision."""
        reach = torch.full_like(like, self.semi_diameter)
        return self.shape.sag_and_gradient(self.parameters, reach, torch.zeros_like(like))[0]

    @property
    def semi_diameter(self) -> float:
        """Return the distance of the clear aperture's farthest point from the vertex, mm."""
        return self.aperture.semi_diameter

    @property
    def edge_radius(self) -> float | Tensor:
        """Return the semi-diameter, mm, with its gradient where there is one."""
        return self.semi_diameter if self.edge is None else self.edge

    def edge_distance(self, x: Tensor, y: Tensor) -> Tensor:
        """Return how far points (mm, in the surface's axes) lie inside the aperture's edge;
        negative outside.  It is differentiable in the points and in `edge`.
        """
        depth = self.aperture.depth(x, y)
        if self.edge is None:
            return depth
        # Of an obscuration the distance does not move with the outer edge.
        outer = self.aperture.edge.depth(x, y) <= depth
        return depth + torch.where(outer, (self.edge - self.edge.detach()).to(depth), 0.0)
