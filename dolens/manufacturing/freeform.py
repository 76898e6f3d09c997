"""A surface without an axis of symmetry as a tensor product of cubic splines over a rectangle."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline as ScipySpline

from dolens.errors import InputError
from dolens.manufacturing.glass_elements import Face
from dolens.manufacturing.meridians import greville
from dolens.optics.surfaces.b_spline import BSpline

_SHARE = 0.1
_FIRST_SPANS = 4
_MOST_SPANS = 256
_BETWEEN = (0.0694, 0.3300, 0.5000, 0.6700, 0.9306)


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
    spans = _FIRST_SPANS
    while spans <= _MOST_SPANS:
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
        f"surface {face.number}: no spline of up to {_MOST_SPANS} × {_MOST_SPANS} spans follows "
        f"its sag to {1e6 * tolerance:g} nm (the last one was off by {1e6 * error:.3g} nm)"
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
