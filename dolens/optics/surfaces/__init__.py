"""Surface shapes.  A new one is a file here and a line in `SURFACES`."""

from dolens.optics.surfaces.b_spline import BSpline
from dolens.optics.surfaces.base import Surface, SurfaceState
from dolens.optics.surfaces.conic import Conic, Sphere
from dolens.optics.surfaces.even_asphere import EvenAsphere
from dolens.optics.surfaces.plane import Aperture, Plane
from dolens.optics.surfaces.xy_polynomial import XYPolynomial

SURFACES: dict[str, type[Surface]] = {
    shape.kind: shape
    for shape in (Plane, Aperture, Sphere, Conic, EvenAsphere, XYPolynomial, BSpline)
}

__all__ = [
    "SURFACES",
    "Aperture",
    "BSpline",
    "Conic",
    "EvenAsphere",
    "Plane",
    "Sphere",
    "Surface",
    "SurfaceState",
    "XYPolynomial",
]
