"""The optical surfaces of solids are measured against the sags of a lens.

A line along a surface's axis enters the glass through the element's front and leaves it through
its back.  So the two faces are found in a solid without any knowledge of how it was made.  Points
of a face are then compared with the sag at their own x and y.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from dolens.errors import InputError
from dolens.manufacturing.glass_elements import Face, GlassElement
from dolens.manufacturing.modeller import Shape, occ, point
from dolens.optics.surfaces.clear_aperture import Rectangle

_NM_PER_MM = 1e6
# A line is sent through a solid here, as a share of the clear aperture, to find its two faces.
_PROBE = (0.31, 0.17)
_STEPS = 8
# x and y of a point are met to this length, mm: far below a nanometre on any slope.
_ACCURACY = 1e-11
# A point lies within the edges of a face up to this length, mm.
_EDGE = 1e-6


@dataclass(frozen=True)
class SagError:
    """How far an optical surface of a solid lies from the sag of the lens.

    Attributes:
        element: name of the solid's element.
        surface: number in the lens.
        kind: what the face is in the file: `plane`, `sphere`, `revolved spline`, `spline`, ….
        points: number of points, all over the clear aperture.
        largest: nm, of the errors' magnitudes.
        rms: nm.
    """

    element: str
    surface: int
    kind: str
    points: int
    largest: float
    rms: float


def sag_errors(element: GlassElement, solid: Shape, points: int = 400) -> list[SagError]:
    """Measure front and back of an element's solid along their axes.

    Args:
        element: as designed.
        solid: as read from a file, in the lens's axes, mm.
        points: over the clear aperture, spread evenly by Sobol's sequence, and 32 along its edge.

    Raises:
        InputError: a line inside the clear aperture misses the solid.
    """
    return [
        _measured(element, face, solid, is_front, points)
        for face, is_front in ((element.front, True), (element.back, False))
    ]


def aperture_points(face: Face, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (mm) of points that fill a face's clear aperture evenly, and of its edge."""
    power = int(np.ceil(np.log2(count)))
    u, v = qmc.Sobol(2, scramble=False).random_base2(power)[1:].T
    angle = np.arange(32) * (np.pi / 16.0) + 0.1
    edge = face.aperture.edge
    if isinstance(edge, Rectangle):
        square = np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
        x = np.concatenate([2.0 * u - 1.0, np.cos(angle) / square])
        y = np.concatenate([2.0 * v - 1.0, np.sin(angle) / square])
        return edge.half_width_x * x, edge.half_width_y * y
    r = np.concatenate([np.sqrt(u), np.ones(32)]) * edge.semi_diameter
    angle = np.concatenate([2.0 * np.pi * v, angle])
    return r * np.cos(angle), r * np.sin(angle)


def _measured(
    element: GlassElement, face: Face, solid: Shape, is_front: bool, points: int
) -> SagError:
    found = _face(element, face, solid, is_front)
    x, y = aperture_points(face, points)
    surface = occ("BRepAdaptor").BRepAdaptor_Surface(found)
    start = _starts(found, face.to_lens(np.stack([x, y, face.sag(x, y)], -1)))
    parameters, met = _at(surface, face, x, y, start)
    classify = occ("BRepClass").BRepClass_FaceClassifier()
    outside = occ("TopAbs").TopAbs_OUT
    for number, (u, v) in enumerate(parameters):
        off = np.hypot(met[number, 0] - x[number], met[number, 1] - y[number])
        classify.Perform(found, occ("gp").gp_Pnt2d(u, v), _EDGE)
        if not off <= 1e3 * _ACCURACY or classify.State() == outside:
            raise InputError(
                f"{element.title}: the solid has no surface {face.number} at x = {x[number]:.4g}, "
                f"y = {y[number]:.4g} mm"
            )
    error = _NM_PER_MM * (met[:, 2] - face.sag(met[:, 0], met[:, 1]))
    return SagError(
        element.name,
        face.number,
        _kind(surface),
        len(x),
        float(np.abs(error).max()),
        float(np.sqrt(np.mean(error**2))),
    )


def _face(element: GlassElement, face: Face, solid: Shape, is_front: bool) -> Shape:
    """Return the face by which a line along a surface's axis enters or leaves a solid."""
    x, y = (share * size for share, size in zip(_PROBE, face.aperture.edge.extent, strict=True))
    start = face.to_lens(np.array([x, y, 0.0]))
    gp, finder = occ("gp"), occ("IntCurvesFace").IntCurvesFace_ShapeIntersector()
    finder.Load(solid, 1e-7)
    finder.Perform(gp.gp_Lin(point(*start), gp.gp_Dir(*map(float, face.rotation[:, 2]))), -1e4, 1e4)
    met = [(finder.WParameter(k), k) for k in range(1, finder.NbPnt() + 1)]
    if len(met) != 2:
        raise InputError(
            f"{element.title}: a line along its axis meets {len(met)} faces of the solid, not 2"
        )
    return finder.Face((min(met) if is_front else max(met))[1])


def _starts(found: Shape, near: np.ndarray) -> list[tuple[float, float]]:
    """Return parameters of points of a face's surface next to other points, (N, 3)."""
    surface = occ("ShapeAnalysis").ShapeAnalysis_Surface(occ("BRep").BRep_Tool.Surface_s(found))
    pairs = (surface.ValueOfUV(point(*p), 1e-6) for p in near)
    return [(pair.X(), pair.Y()) for pair in pairs]


def _at(
    surface: Shape, face: Face, x: np.ndarray, y: np.ndarray, start: list[tuple[float, float]]
) -> tuple[list[tuple[float, float]], np.ndarray]:
    """Return parameters of the surface's points above x and y (mm), by Newton's iteration, and
    these points in the axes of the face, (N, 3).
    """
    gp = occ("gp")
    place, along_u, along_v = gp.gp_Pnt(), gp.gp_Vec(), gp.gp_Vec()
    parameters, points = [], np.empty((len(x), 3))
    for number, (u, v) in enumerate(start):
        for _ in range(_STEPS):
            surface.D1(u, v, place, along_u, along_v)
            here = face.from_lens(np.array([place.X(), place.Y(), place.Z()]))
            off = np.array([x[number], y[number]]) - here[:2]
            if np.abs(off).max() <= _ACCURACY:
                break
            slopes = np.array([[d.X(), d.Y(), d.Z()] for d in (along_u, along_v)]) @ face.rotation
            step = np.linalg.solve(slopes[:, :2].T, off)
            u, v = u + float(step[0]), v + float(step[1])
        points[number] = here
        parameters.append((u, v))
    return parameters, points


def _kind(surface: Shape) -> str:
    """Return what a surface is in the file, in words."""
    names = {
        "GeomAbs_Plane": "plane",
        "GeomAbs_Sphere": "sphere",
        "GeomAbs_SurfaceOfRevolution": "revolved spline",
        "GeomAbs_BSplineSurface": "spline",
        "GeomAbs_Cone": "cone",
        "GeomAbs_Cylinder": "cylinder",
    }
    return names.get(surface.GetType().name, "other")
