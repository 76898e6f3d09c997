"""The image surface may be curved: a retina, the film of a Schmidt camera.

It is one more surface behind the lens's last, at which nothing is refracted and nothing clipped.  A
lens without one ends on the plane of its sensor.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import ClearAperture, Unlimited
from dolens.optics.surfaces.conic import Conic, Sphere
from dolens.optics.surfaces.state import SurfaceState

# Parameters of a lens whose image is curved: 1/mm at the vertex, and the conic constant.
CURVATURE, CONIC = "sensor_curvature", "sensor_conic"

# It clips nothing; rays are lost a thousand times as far off the axis, mm.
WITHOUT_EDGE = ClearAperture(Unlimited(1e6))


def register_image_surface(
    lens: nn.Module, curvature: float | None, conic: float | None, dtype: torch.dtype
) -> None:
    """Give a lens the parameters of its curved sensor; a plane has none.

    Args:
        lens: with a name.
        curvature: 1/mm, its sign as any surface's; None: a plane.
        conic: the conic constant; None: a sphere.
        dtype: precision of the parameters.

    Raises:
        InputError: a conic constant without a curvature.
    """
    if curvature is None and conic is not None:
        raise InputError(f"lens '{lens.name}': a sensor with a conic constant needs a curvature")
    for name, value in ((CURVATURE, curvature), (CONIC, conic)):
        given = None if value is None else torch.tensor(float(value), dtype=dtype)
        lens.register_parameter(name, None if given is None else nn.Parameter(given))


def image_surface(lens: nn.Module, values: dict[str, Tensor]) -> SurfaceState | None:
    """Return the curved surface that a lens's rays end on, or None where that is a plane.

    Args:
        lens: holds the parameters.
        values: name → tensor used in the place of the stored one; what is used is taken out.
    """
    own_curvature, own_conic = lens._parameters[CURVATURE], lens._parameters[CONIC]
    if own_curvature is None:
        return None
    curvature = values.pop(CURVATURE, own_curvature)
    if own_conic is None:
        return SurfaceState(Sphere, {"curvature": curvature}, WITHOUT_EDGE)
    conic = values.pop(CONIC, own_conic)
    return SurfaceState(Conic, {"curvature": curvature, "conic": conic}, WITHOUT_EDGE)


def image_reach(image: SurfaceState) -> float:
    """Return the distance from the axis, mm, at which an image surface ends; `inf` where it goes
    on.
    """
    c = float(image.parameters["curvature"].detach())
    conic = image.parameters.get("conic")
    alpha = (1.0 + (0.0 if conic is None else float(conic.detach()))) * c * c
    return 1.0 / math.sqrt(alpha) if alpha > 0.0 else math.inf


@dataclass(frozen=True)
class TangentPlanes:
    """Planes touch the image surface at N points.

    Axes in such a plane are the sensor's own, turned by the smallest rotation that takes z to the
    normal: along a meridian, lengths in it are lengths along the surface.

    Attributes:
        point: (..., 3), mm, in the sensor's axes from its vertex; no gradient.
        normal: (..., 3), unit vectors towards +z; no gradient.
    """

    point: Tensor
    normal: Tensor

    @classmethod
    @torch.no_grad()
    def at(cls, image: SurfaceState, centre: Tensor) -> "TangentPlanes":
        """Return the planes at x and y (..., 2) in mm.

        Raises:
            InputError: a point lies beyond the end of the surface.
        """
        x, y = centre.unbind(-1)
        sag, _, _, exists = image.shape.sag_and_gradient(image.parameters, x, y)
        if exists is not None and bool((exists < 0.0).any()):
            radius = 1.0 / float(image.parameters["curvature"])
            raise InputError(
                f"the sensor's radius is {radius:g} mm: it ends short of "
                f"{float(torch.hypot(x, y).nan_to_num().max()):g} mm from the axis"
            )
        normal = image.shape.normal(image.parameters, x, y, sag)
        return cls(torch.stack((x, y, sag), -1), torch.stack(normal, -1))

    def turned(self, vector: Tensor) -> Tensor:
        """Return vectors (..., 3) of the sensor's axes in those of the planes.

        With N the normal, v' = v - (N_x, N_y)·(v_z + (N_x·v_x + N_y·v_y)/(1 + N_z)) across it and
        v'_z = v·N.
        """
        across = (vector[..., :2] * self.normal[..., :2]).sum(-1)
        z, along = vector[..., 2], across + vector[..., 2] * self.normal[..., 2]
        share = z + across / (1.0 + self.normal[..., 2])
        turned = vector[..., :2] - self.normal[..., :2] * share[..., None]
        return torch.cat([turned, along[..., None]], -1)

    def unsqueeze(self, dim: int) -> "TangentPlanes":
        """Return the same with a further dimension."""
        return TangentPlanes(self.point.unsqueeze(dim), self.normal.unsqueeze(dim))
