"""The solid modeller Open CASCADE, and surfaces as the lines, arcs and splines that it has.

Its Python package `OCP`, which the extra `cad` installs, is imported when a solid is first
wanted, and nowhere else.  Of a surface of revolution the meridian is a curve: a plane is a line
and a sphere an arc, exactly.  Any other conic is a rational quadratic Bézier arc, exactly too.
Everything else is a cubic spline through the sag.  A surface without an axis of symmetry is a
tensor product of cubic splines over a rectangle.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from scipy.interpolate import BSpline as ScipySpline
from scipy.interpolate import make_interp_spline

from dolens.errors import InputError
from dolens.manufacturing.glass_elements import Face
from dolens.optics.surfaces.b_spline import BSpline
from dolens.optics.surfaces.conic import Conic

# A spline is refined until it is this share of the tolerance from the sag.
_SHARE = 0.1
_FIRST_SPANS = 16
_MOST_SPANS = 4096
# Spans of a surface, along x and along y.
_FIRST_SPANS_ACROSS = 4
_MOST_SPANS_ACROSS = 256
# Points within each span at which a fit is looked at; none of them is a knot.
_BETWEEN = (0.0694, 0.3300, 0.5000, 0.6700, 0.9306)
# Share of the reach at which the slope at the vertex is taken.
_BESIDE = 1e-12
# Arcs of larger radii are Bézier arcs: a centre 10 km away would cost the vertex its last digits.
_LARGEST_RADIUS = 1e7


@dataclass(frozen=True)
class Line:
    """The meridian is straight: from the vertex to (r, 0), mm."""

    radius: float


@dataclass(frozen=True)
class Arc:
    """The meridian is an arc of a circle from the vertex.

    Attributes:
        radius: mm, signed: positive where the centre lies towards +z.
        angle: radians, that the arc spans, up to π/2.
    """

    radius: float
    angle: float


@dataclass(frozen=True)
class Spline:
    """The meridian is a spline from the vertex to the rim.

    Attributes:
        degree: of its polynomials.
        knots: distinct ones, in order.
        multiplicities: of the knots.
        poles: (n, 2), r and z, mm.
        weights: (n,), of a rational one, or None.
    """

    degree: int
    knots: np.ndarray
    multiplicities: np.ndarray
    poles: np.ndarray
    weights: np.ndarray | None = None


Meridian = Line | Arc | Spline


def meridian(face: Face, reach: float, tolerance: float) -> Meridian:
    """Return the curve of a surface of revolution from the vertex out to `reach`.

    Args:
        face: of a shape with rotational symmetry.
        reach: mm from the axis.
        tolerance: mm, that the curve may be off in sag.

    Raises:
        InputError: no spline of reasonable size comes within the tolerance, or the sag ends before
            `reach`.
    """
    if face.flat:
        return Line(reach)
    rim = float(face.sag(np.array(reach), np.array(0.0)))
    if not np.isfinite(rim):
        raise InputError(f"surface {face.number} has no sag at {reach:g} mm from the axis")
    if _is_conic(face):
        c = float(face.parameters["curvature"])
        k = float(face.parameters.get("conic", 0.0))
        if k == 0.0 and abs(1.0 / c) < _LARGEST_RADIUS:
            return Arc(1.0 / c, float(np.arcsin(min(1.0, abs(c) * reach))))
        return conic_arc(c, k, reach)
    return spline_meridian(face, reach, tolerance)


def conic_arc(c: float, k: float, reach: float) -> Spline:
    """Return a conic's meridian r² - 2Rz + (1+k)z² = 0 as a rational quadratic Bézier arc.

    Its ends are the vertex P0 and the rim P2, its middle pole P1 where the tangents there meet.
    With M = (P0 + P2)/2 and F the conic's quadratic form in homogeneous coordinates, P1 is the
    pole of the chord through M, so F(M + w·P1) = F(M) + w²·F(P1), which is zero for the weight
    w = √(-F(M)/F(P1)).

    Args:
        c: curvature 1/R, 1/mm; not zero.
        k: conic constant.
        reach: mm from the axis, on the sag branch.
    """
    root = np.sqrt(max(0.0, 1.0 - (1.0 + k) * c * c * reach * reach))
    z = c * reach * reach / (1.0 + root)
    # The tangent at the rim has the slope c·r/root, so it reaches z = 0 at r - z·root/(c·r).
    pole = reach - z * root / (c * reach)

    def form(x: float, y: float) -> float:
        return c * x * x - 2.0 * y + (1.0 + k) * c * y * y

    weight = np.sqrt(-form(0.5 * reach, 0.5 * z) / (c * pole * pole))
    return Spline(
        2,
        np.array([0.0, 1.0]),
        np.array([3, 3]),
        np.array([[0.0, 0.0], [pole, 0.0], [reach, z]]),
        np.array([1.0, weight, 1.0]),
    )


def spline_meridian(face: Face, reach: float, tolerance: float) -> Spline:
    """Return a cubic spline through the sag, with its slopes at vertex and rim.

    Its parameter is the distance from the axis.  The number of spans doubles until the spline is
    within a tenth of the tolerance between its knots.
    """
    spans = _FIRST_SPANS
    while spans <= _MOST_SPANS:
        r = np.linspace(0.0, reach, spans + 1)
        sag = face.sag(r, np.zeros_like(r))
        # The vertex itself may be a cusp (an axicon's): its slope is that beside it.
        beside = np.maximum(r, _BESIDE * reach)
        slope = face.sag_and_slopes(beside, np.zeros_like(r))[1]
        spline = make_interp_spline(
            r, sag, k=3, bc_type=([(1, float(slope[0]))], [(1, float(slope[-1]))])
        )
        between = (np.arange(spans)[:, None] + np.array(_BETWEEN)).ravel() * (reach / spans)
        error = np.abs(spline(between) - face.sag(between, np.zeros_like(between))).max()
        if error <= _SHARE * tolerance:
            knots, multiplicities = np.unique(spline.t, return_counts=True)
            poles = np.stack([greville(spline.t), spline.c], -1)
            return Spline(3, knots, multiplicities, poles)
        spans *= 2
    raise InputError(
        f"surface {face.number}: no spline of up to {_MOST_SPANS} spans follows its sag to "
        f"{1e6 * tolerance:g} nm (the last one was off by {1e6 * error:.3g} nm)"
    )


def greville(knots: np.ndarray, degree: int = 3) -> np.ndarray:
    """Return Σ t_(i+1…i+degree)/degree: the coefficients of the spline that is the identity."""
    count = len(knots) - degree - 1
    return np.stack([knots[1 + j : 1 + j + count] for j in range(degree)]).mean(0)


def _is_conic(face: Face) -> bool:
    """Return whether a surface is a conic of revolution: a4, a6, … are absent or zero."""
    further = (p for name, p in face.parameters.items() if name not in ("curvature", "conic"))
    return issubclass(face.shape, Conic) and all(float(p) == 0.0 for p in further)


@dataclass(frozen=True)
class TensorSpline:
    """z(x, y) = Σ c_ij·N_i(x)·N_j(y) with cubic B-splines N.

    Attributes:
        knots_x: (n + 4,), mm, quadruple at both ends.
        knots_y: (m + 4,), mm.
        coefficients: (n, m), mm.
    """

    knots_x: np.ndarray
    knots_y: np.ndarray
    coefficients: np.ndarray

    @property
    def poles(self) -> np.ndarray:
        """Return the control points (n, m, 3), mm: over the Greville abscissae x(u) = u exactly."""
        x, y = np.meshgrid(greville(self.knots_x), greville(self.knots_y), indexing="ij")
        return np.stack([x, y, self.coefficients], -1)

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return z (mm) at points (mm) of the rectangle, (N,)."""
        rows = ScipySpline.design_matrix(x, self.knots_x, 3) @ self.coefficients
        return np.asarray(
            ScipySpline.design_matrix(y, self.knots_y, 3).multiply(rows).sum(-1)
        ).ravel()


def tensor_spline(face: Face, reach: float, used: float, tolerance: float) -> TensorSpline:
    """Return a surface as a tensor-product spline over the square of half width `reach`.

    The spline of a `b_spline` surface is taken over as it is; past its rectangle it goes on
    straight, as the surface does.  Any other shape is interpolated on grids that become finer until
    it is met within a tenth of the tolerance.

    Args:
        face: of any shape.
        reach: mm, half width of the square.
        used: mm, radius of the disc within which the tolerance holds.
        tolerance: mm.

    Raises:
        InputError: no spline of reasonable size comes within the tolerance.
    """
    if issubclass(face.shape, BSpline):
        return _collocated(face, _own_knots(face, "x", reach), _own_knots(face, "y", reach))
    spans = _FIRST_SPANS_ACROSS
    while spans <= _MOST_SPANS_ACROSS:
        inner = np.linspace(-reach, reach, spans + 1)
        knots = np.concatenate([[-reach] * 3, inner, [reach] * 3])
        spline = _collocated(face, knots, knots)
        between = -reach + (np.arange(spans)[:, None] + np.array(_BETWEEN)).ravel() * (
            2.0 * reach / spans
        )
        x, y = (grid.ravel() for grid in np.meshgrid(between, between))
        inside = np.hypot(x, y) <= used
        x, y = x[inside], y[inside]
        error = np.abs(spline(x, y) - face.sag(x, y)).max()
        if error <= _SHARE * tolerance:
            return spline
        spans *= 2
    raise InputError(
        f"surface {face.number}: no spline of up to {_MOST_SPANS_ACROSS} × {_MOST_SPANS_ACROSS} "
        f"spans follows its sag to {1e6 * tolerance:g} nm (the last one was off by "
        f"{1e6 * error:.3g} nm)"
    )


def _collocated(face: Face, knots_x: np.ndarray, knots_y: np.ndarray) -> TensorSpline:
    """Return the spline with these knots that meets the sag at the Greville abscissae."""
    u, v = greville(knots_x), greville(knots_y)
    x, y = np.meshgrid(u, v, indexing="ij")
    # Where the branch has ended, in the corners, the numbers are finite and touch little inside.
    values = face.sag_and_slopes(x, y)[0]
    a = ScipySpline.design_matrix(u, knots_x, 3).toarray()
    b = ScipySpline.design_matrix(v, knots_y, 3).toarray()
    return TensorSpline(knots_x, knots_y, np.linalg.solve(b, np.linalg.solve(a, values).T).T)


def _own_knots(face: Face, axis: str, reach: float) -> np.ndarray:
    """Return a spline surface's own knots, clamped, with a straight piece where it must go on."""
    stored = face.parameters[f"knots_{axis}"].numpy()
    low, high = stored[3], stored[-4]
    inner, counts = np.unique(stored[(stored > low) & (stored < high)], return_counts=True)
    if (counts > 3).any():
        raise InputError(f"surface {face.number}: its spline has a step, which no solid can have")
    knots = [np.repeat(inner, counts)]
    # Two continuous numbers, value and slope, across the end of the rectangle: a double knot.
    knots.insert(0, np.array([-reach] * 4 + [low] * 2) if -reach < low else np.full(4, low))
    knots.append(np.array([high] * 2 + [reach] * 4) if reach > high else np.full(4, high))
    return np.concatenate(knots)


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
