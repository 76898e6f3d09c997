"""The image surface may be curved: a retina, the film of a Schmidt camera.

It is one more surface behind the lens's last, at which nothing is refracted and nothing clipped.  A
lens without one ends on the plane of its sensor.
"""

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


def register_image_surface(lens: nn.Module, curvature: float | None, conic: float | None) -> None:
    """Give a lens the parameters of its curved sensor; a plane has none.

    Args:
        lens: with `sensor_distance`.
        curvature: 1/mm, its sign as any surface's; None: a plane.
        conic: the conic constant; None: a sphere.

    Raises:
        InputError: a conic constant without a curvature.
    """
    if curvature is None and conic is not None:
        raise InputError(f"lens '{lens.name}': a sensor with a conic constant needs a curvature")
    for name, value in ((CURVATURE, curvature), (CONIC, conic)):
        if value is not None:
            value = nn.Parameter(lens.sensor_distance.detach().new_tensor(float(value)))
        lens.register_parameter(name, value)


def image_surface(lens: nn.Module, values: dict[str, Tensor]) -> SurfaceState | None:
    """Return the curved surface that a lens's rays end on, or None where that is a plane.

    Args:
        lens: holds the parameters.
        values: name → tensor used in the place of the stored one; what is used is taken out.
    """
    stored = lens._parameters
    if stored[CURVATURE] is None:
        return None
    curvature = values.pop(CURVATURE, stored[CURVATURE])
    if stored[CONIC] is None:
        return SurfaceState(Sphere, {"curvature": curvature}, WITHOUT_EDGE)
    conic = values.pop(CONIC, stored[CONIC])
    return SurfaceState(Conic, {"curvature": curvature, "conic": conic}, WITHOUT_EDGE)


def image_sag(image: SurfaceState | None, x: Tensor, y: Tensor) -> Tensor:
    """Return the sag (mm) of the image surface at x and y (mm): zero of a plane.

    Raises:
        InputError: a point lies beyond the end of the surface.
    """
    if image is None:
        return torch.zeros_like(x + y)
    sag, _, _, exists = image.shape.sag_and_gradient(image.parameters, x, y)
    if exists is not None and not bool((exists >= 0.0).all()):
        radius = float((x.detach() ** 2 + y.detach() ** 2).max().sqrt())
        raise InputError(
            f"the image surface, of radius {1.0 / float(image.parameters['curvature']):g} mm, ends "
            f"short of {radius:g} mm from the axis"
        )
    return sag
