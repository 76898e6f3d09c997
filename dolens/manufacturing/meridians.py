"""The meridian of a surface of revolution as a curve that a solid modeller has.

A plane is a line and a sphere an arc, exactly.  Any other conic is a rational quadratic Bézier
arc, exactly too.  Everything else is a cubic spline through the sag.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from dolens.errors import InputError
from dolens.manufacturing.glass_elements import Face
from dolens.optics.surfaces.conic import Conic

# A spline is refined until it is this share of the tolerance from the sag.
_SHARE = 0.1
_FIRST_SPANS = 16
_MOST_SPANS = 4096
# Points within each span at which a fit is looked at; none of them is a knot.
# Share of the reach at which the slope at the vertex is taken.
_BESIDE = 1e-12
_BETWEEN = (0.0694, 0.3300, 0.5000, 0.6700, 0.9306)
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
