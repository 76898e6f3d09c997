"""Lenses whose wavefronts are known in closed form."""

import math

from dolens import Lens
from dolens.optics.materials import index_model, parse_material
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.conic import Conic
from dolens.optics.surfaces.plane import Plane

_MODEL = index_model("dfc")
AIR = parse_material("air", _MODEL)
GLASS = parse_material("1.5", _MODEL)
N = 1.5


def _fixed(surfaces, thicknesses, sensor_distance, materials, **options) -> Lens:
    """A lens with its stop in front, whose parameters want no gradient."""
    lens = Lens(surfaces, thicknesses, sensor_distance, materials, stop=1, **options)
    return lens.requires_grad_(False)


def hyperbola(
    focal_length: float = 50.0,
    aperture: float | ClearAperture = 2.5,
    defocus: float = 0.0,
    gap: float = 0.0,
    **options,
) -> Lens:
    """A plane and a hyperboloid of conic constant -n²: every axial ray from infinity meets in the
    rear focus.  The plane is the stop; `gap` mm of air separate a stop in front from it.
    """
    rear = Conic(40.0, {"curvature": -1.0 / ((N - 1.0) * focal_length), "conic": -N * N})
    distance = focal_length + defocus
    if gap:
        surfaces = [Plane(aperture, {}), Plane(40.0, {}), rear]
        return _fixed(surfaces, [gap, 4.0], distance, [AIR, AIR, GLASS, AIR], **options)
    return _fixed([Plane(aperture, {}), rear], [4.0], distance, [AIR, GLASS, AIR], **options)


def hyperbola_height(sine: float, focal_length: float) -> float:
    """Height of the axial ray that meets the focus of `hyperbola` at an angle θ.

    In polar coordinates about the focus the surface is ρ = f·(n - 1)/(n·cos θ - 1).
    """
    cosine = math.sqrt(1.0 - sine * sine)
    return focal_length * (N - 1.0) / (N * cosine - 1.0) * sine


def ellipse(radius: float = 20.0, aperture: float = 2.0) -> Lens:
    """An ellipsoid of conic constant -1/n² before glass that reaches to the sensor: axial rays from
    infinity meet at n·R/(n - 1).
    """
    front = Conic(aperture, {"curvature": 1.0 / radius, "conic": -1.0 / N**2})
    return _fixed([front], [], N * radius / (N - 1.0), [AIR, GLASS])


def relay(object_distance: float, focal_length: float = 60.0, aperture: float = 5.0) -> Lens:
    """Two hyperboloids with a collimated beam between them: the axial point at that distance in
    front of the first vertex is imaged perfectly.
    """
    front = Conic(aperture, {"curvature": 1.0 / ((N - 1.0) * object_distance), "conic": -N * N})
    rear = Conic(3 * aperture, {"curvature": -1.0 / ((N - 1.0) * focal_length), "conic": -N * N})
    return _fixed([front, rear], [5.0], focal_length, [AIR, GLASS, AIR])


def pinhole(
    aperture: float | ClearAperture, distance: float = 50.0, second: tuple[float, float] = ()
) -> Lens:
    """Nothing but a hole in front of the sensor, or two: `second` is (gap, semi-diameter), mm."""
    if not second:
        return _fixed([Plane(aperture, {})], [], distance, [AIR, AIR])
    gap, other = second
    return _fixed([Plane(aperture, {}), Plane(other, {})], [gap], distance, [AIR] * 3)
