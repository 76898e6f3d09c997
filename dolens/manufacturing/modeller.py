"""The solid modeller Open CASCADE, which the extra `cad` installs, and its small vocabulary here.

Its Python package `OCP` is imported when a solid is first wanted, and nowhere else.
"""

import importlib
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from dolens.errors import InputError
from dolens.manufacturing.freeform import TensorSpline
from dolens.manufacturing.meridians import Arc, Line, Meridian

# A solid, face, edge or wire of the modeller; its package has no types that could be named here.
Shape = Any


def occ(name: str) -> ModuleType:
    """Import a part of Open CASCADE, as `gp` or `BRepPrimAPI`.

    Raises:
        InputError: it is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(f"OCP.{name}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "OCP":
            raise
        raise InputError(
            "STEP files need the solid modeller Open CASCADE, which is not installed; "
            "install it by: pip install 'dolens[cad]'"
        ) from None


def point(x: float, y: float, z: float) -> Any:
    """Return a point, mm."""
    return occ("gp").gp_Pnt(float(x), float(y), float(z))


def edge(start: Sequence[float], end: Sequence[float]) -> Shape:
    """Return the straight edge between two points (r, z) of the plane y = 0, mm."""
    build = occ("BRepBuilderAPI").BRepBuilderAPI_MakeEdge
    return build(point(start[0], 0.0, start[1]), point(end[0], 0.0, end[1])).Edge()


def meridian_edge(curve: Meridian, z: float) -> Shape:
    """Return the edge of a meridian, from its vertex at z (mm) outwards in the plane y = 0."""
    gp, geom = occ("gp"), occ("Geom")
    build = occ("BRepBuilderAPI").BRepBuilderAPI_MakeEdge
    if isinstance(curve, Line):
        return edge((0.0, z), (curve.radius, z))
    if isinstance(curve, Arc):
        # From the centre the vertex lies along `start`, and the arc turns from there towards +x.
        side = -1.0 if curve.radius > 0.0 else 1.0
        start, normal = gp.gp_Dir(0.0, 0.0, side), gp.gp_Dir(0.0, side, 0.0)
        axes = gp.gp_Ax2(point(0.0, 0.0, z + curve.radius), normal, start)
        return build(gp.gp_Circ(axes, abs(curve.radius)), 0.0, curve.angle).Edge()
    poles = _points([(r, 0.0, z + s) for r, s in curve.poles])
    knots = (_numbers(curve.knots), _integers(curve.multiplicities))
    weights = () if curve.weights is None else (_numbers(curve.weights),)
    return build(geom.Geom_BSplineCurve(poles, *weights, *knots, curve.degree)).Edge()


def revolved(edges: Sequence[Shape]) -> Shape:
    """Return the solid that a closed outline in the half plane y = 0, x ≥ 0 makes about z."""
    api, gp = occ("BRepBuilderAPI"), occ("gp")
    wire = api.BRepBuilderAPI_MakeWire()
    for part in edges:
        wire.Add(part)
    outline = api.BRepBuilderAPI_MakeFace(wire.Wire(), True).Face()
    axis = gp.gp_Ax1(point(0.0, 0.0, 0.0), gp.gp_Dir(0.0, 0.0, 1.0))
    return _oriented(occ("BRepPrimAPI").BRepPrimAPI_MakeRevol(outline, axis).Shape())


def beyond(spline: TensorSpline, length: float) -> Shape:
    """Return the solid between a freeform surface and the same surface `length` mm along z."""
    poles = spline.poles
    grid = occ("collections").Array2_gp_Pnt(1, poles.shape[0], 1, poles.shape[1])
    for i, row in enumerate(poles, 1):
        for j, pole in enumerate(row, 1):
            grid.SetValue(i, j, point(*pole))
    (u, mu), (v, mv) = (
        np.unique(knots, return_counts=True) for knots in (spline.knots_x, spline.knots_y)
    )
    numbers = (_numbers(u), _numbers(v), _integers(mu), _integers(mv))
    surface = occ("Geom").Geom_BSplineSurface(grid, *numbers, 3, 3)
    face = occ("BRepBuilderAPI").BRepBuilderAPI_MakeFace(surface, 1e-7).Face()
    along = occ("gp").gp_Vec(0.0, 0.0, length)
    return _oriented(occ("BRepPrimAPI").BRepPrimAPI_MakePrism(face, along).Shape())


def box(low: Sequence[float], high: Sequence[float]) -> Shape:
    """Return the box between two opposite corners (x, y, z), mm."""
    return occ("BRepPrimAPI").BRepPrimAPI_MakeBox(point(*low), point(*high)).Shape()


def common(first: Shape, second: Shape) -> Shape:
    """Return what two solids have in common."""
    return occ("BRepAlgoAPI").BRepAlgoAPI_Common(first, second).Shape()


def moved(shape: Shape, rotation: np.ndarray, origin: np.ndarray) -> Shape:
    """Return a shape with its points p at origin + rotation·p (mm); its geometry is rewritten."""
    transform = occ("gp").gp_Trsf()
    rows = np.concatenate([rotation, np.reshape(origin, (3, 1))], axis=1)
    transform.SetValues(*(float(number) for number in rows.ravel()))
    return occ("BRepBuilderAPI").BRepBuilderAPI_Transform(shape, transform, True).Shape()


def parts(shape: Shape, kind: str) -> list[Shape]:
    """Return the parts of a shape that are of a kind: `SOLID` or `FACE`."""
    top = occ("TopAbs")
    explorer = occ("TopExp").TopExp_Explorer(shape, getattr(top, f"TopAbs_{kind}"))
    found = []
    while explorer.More():
        found.append(getattr(occ("TopoDS").TopoDS, kind.capitalize())(explorer.Current()))
        explorer.Next()
    return found


def is_valid(shape: Shape) -> bool:
    """Return whether the modeller finds the shape's topology and geometry consistent."""
    return bool(occ("BRepCheck").BRepCheck_Analyzer(shape).IsValid())


def volume(solid: Shape) -> float:
    """Return the volume of a solid, mm³."""
    properties = occ("GProp").GProp_GProps()
    occ("BRepGProp").BRepGProp.VolumeProperties_s(solid, properties, 1e-9)
    return float(properties.Mass())


def _oriented(shape: Shape) -> Shape:
    """Return a solid whose faces look outwards."""
    (solid,) = parts(shape, "SOLID")
    occ("BRepLib").BRepLib.OrientClosedSolid_s(solid)
    return solid


def _points(rows: Sequence[Sequence[float]]) -> Any:
    array = occ("collections").Array1_gp_Pnt(1, len(rows))
    for number, row in enumerate(rows, 1):
        array.SetValue(number, point(*row))
    return array


def _numbers(values: np.ndarray) -> Any:
    array = occ("collections").Array1_double(1, len(values))
    for number, value in enumerate(values, 1):
        array.SetValue(number, float(value))
    return array


def _integers(values: np.ndarray) -> Any:
    array = occ("collections").Array1_int(1, len(values))
    for number, value in enumerate(values, 1):
        array.SetValue(number, int(value))
    return array
