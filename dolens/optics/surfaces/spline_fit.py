"""A B-spline surface is fitted to sag data."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dolens.errors import InputError
from dolens.optics.surfaces.b_spline import check_knots

# A column of the least-squares problem that the others explain to this fraction has no data.
DEPENDENT = 1e-12


def fit_b_spline(
    x: ArrayLike,
    y: ArrayLike,
    sag: ArrayLike,
    knots_x: Sequence[float],
    knots_y: Sequence[float],
    smoothing: float = 0.0,
) -> dict[str, Any]:
    """Fit a cubic B-spline through scattered or gridded sag data by least squares.

    Minimises the mean of (s(x, y) - sag)² + smoothing · the mean of s_xx² + 2·s_xy² + s_yy² over
    the knot rectangle, the bending energy of a thin plate.  Data from a circular aperture leave
    the corners of the rectangle open: a little smoothing (1e-12 mm², say) carries
    the surface on into them and leaves the fit to the data as it is.

    Args:
        x: mm; of the shape of `sag`, or (columns,) where `sag` is a grid.
        y: mm; of the shape of `sag`, or (rows,) where `sag` is a grid.
        sag: mm; of any shape, or (rows, columns) on the grid of y and x.
        knots_x: mm, 4 more than there are to be coefficients along x (see `clamped_knots`).
        knots_y: mm, along y.

    Rarely needed:
        smoothing: mm², at least 0.

    Returns:
        `type`, `coefficients` (rows along y, columns along x), `knots_x` and `knots_y`: what a
        surface of a prescription needs besides its semi-diameter, thickness and material.

    Raises:
        InputError: shapes that do not match, numbers that are not finite, data beyond the knots,
            or data that leave coefficients undetermined.
    """
    # Imported here: tracing does not need SciPy.
    from scipy import sparse
    from scipy.interpolate import BSpline

    x, y, sag = _points(x, y, sag)
    if not 0.0 <= smoothing < float("inf"):
        raise InputError(f"'smoothing' must be a number of mm² from 0, not {smoothing}")
    bases = []
    for axis, values, knots in (("x", x, knots_x), ("y", y, knots_y)):
        t = np.asarray(knots, dtype=np.float64)
        if t.ndim != 1 or t.size < 8:
            raise InputError(f"'knots_{axis}' must be one list of at least 8 knots (mm)")
        check_knots(t.tolist(), t.size - 4, f"knots_{axis}")
        low, high = t[3], t[-4]
        if values.min() < low or values.max() > high:
            raise InputError(
                f"data reach from {axis} = {values.min():g} to {values.max():g} mm, beyond the "
                f"knots, which end at {low:g} and {high:g} mm"
            )
        bases.append((t, BSpline.design_matrix(values, t, 3).tocsr()))
    (tx, basis_x), (ty, basis_y) = bases
    rows, columns = ty.size - 4, tx.size - 4
    matrix = _products_of_rows(basis_y, basis_x) / np.sqrt(sag.size)
    target = sag / np.sqrt(sag.size)
    if smoothing > 0.0:
        bending = np.sqrt(smoothing) * _bending(ty, tx)
        target = np.concatenate((target, np.zeros(bending.shape[0])))
        matrix = sparse.vstack((matrix, bending)).tocsr()
    coefficients = _least_squares(matrix, target, columns).reshape(rows, columns)
    return {
        "type": "b_spline",
        "coefficients": coefficients.tolist(),
        "knots_x": tx.tolist(),
        "knots_y": ty.tolist(),
    }


def _points(
    x: ArrayLike, y: ArrayLike, sag: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return scattered or gridded data as three lists of one length."""
    x, y, sag = (np.asarray(values, dtype=np.float64) for values in (x, y, sag))
    if sag.ndim == 2 and x.shape == sag.shape[1:] and y.shape == sag.shape[:1]:
        x, y = np.meshgrid(x, y)
    if not x.shape == y.shape == sag.shape or sag.size == 0:
        raise InputError(
            "sag data need x and y of the shape of sag, or sag of shape (rows, columns) with y of "
            f"(rows,) and x of (columns,), not x {x.shape}, y {y.shape}, sag {sag.shape}"
        )
    for name, values in (("x", x), ("y", y), ("sag", sag)):
        if not np.isfinite(values).all():
            count = int((~np.isfinite(values)).sum())
            raise InputError(f"sag data: {count} of {values.size} values of {name} are not finite")
    return x.ravel(), y.ravel(), sag.ravel()


def _products_of_rows(a: Any, b: Any) -> Any:
    """Return rows that are the outer products of the rows of a and b (four entries each)."""
    from scipy import sparse

    a_value, b_value = (m.data.reshape(-1, 4, 1) for m in (a, b))
    a_index, b_index = (m.indices.astype(np.int64).reshape(-1, 4, 1) for m in (a, b))
    value = a_value * b_value.transpose(0, 2, 1)
    column = a_index * b.shape[1] + b_index.transpose(0, 2, 1)
    start = np.arange(0, value.size + 1, 16)
    shape = (a.shape[0], a.shape[1] * b.shape[1])
    return sparse.csr_array((value.ravel(), column.ravel(), start), shape=shape)


def _bending(ty: np.ndarray, tx: np.ndarray) -> Any:
    """Return rows whose squares sum to the mean of s_xx² + 2·s_xy² + s_yy², by Gauss's rule,
    exactly.
    """
    from scipy import sparse

    y, x = ([_at_gauss_points(t, order) for order in range(3)] for t in (ty, tx))
    area = (ty[-4] - ty[3]) * (tx[-4] - tx[3])
    parts = (
        sparse.kron(y[0], x[2]),
        np.sqrt(2.0) * sparse.kron(y[1], x[1]),
        sparse.kron(y[2], x[0]),
    )
    return sparse.vstack(parts) / np.sqrt(area)


def _at_gauss_points(t: np.ndarray, order: int) -> Any:
    """Return derivatives of the basis at four points a span, times the root of the point's
    weight.
    """
    from scipy import sparse
    from scipy.interpolate import BSpline

    node, weight = np.polynomial.legendre.leggauss(4)
    ends = np.unique(t[3:-3])
    half = 0.5 * np.diff(ends)[:, None]
    point = (ends[:-1, None] + half * (1.0 + node)).ravel()
    basis = BSpline(t, np.eye(t.size - 4), 3)(point, nu=order)
    return sparse.csr_array(np.sqrt(half * weight).reshape(-1, 1) * basis)


def _least_squares(matrix: Any, target: np.ndarray, columns: int) -> np.ndarray:
    """Solve by normal equations with scaled columns, and refine by the residual (Björck)."""
    from scipy import sparse
    from scipy.sparse import linalg

    norm = np.sqrt(np.asarray((matrix * matrix).sum(axis=0)).ravel())
    undetermined = np.flatnonzero(norm == 0.0)
    if undetermined.size == 0:
        scaled = (matrix @ sparse.diags_array(1.0 / norm)).tocsr()
        # Diagonal pivots, as for a Cholesky factorization: each is the part of its column that
        # those before it do not explain.
        try:
            factor = linalg.splu(
                (scaled.T @ scaled).tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # "Factor is exactly singular"
            factor = None
        if factor is not None:
            pivots = np.abs(factor.U.diagonal())
            undetermined = np.flatnonzero((pivots < DEPENDENT)[factor.perm_c])
        if factor is not None and undetermined.size == 0:
            solution = np.zeros_like(norm)
            for _ in range(3):
                residual = target - scaled @ solution
                solution = solution + factor.solve(scaled.T @ residual)
            return solution / norm
    where = ""
    if undetermined.size:
        row, column = divmod(int(undetermined[0]), columns)
        where = f" (the first: row {row + 1}, column {column + 1})"
    raise InputError(
        f"the sag data leave coefficients undetermined{where}; give data in every span of the "
        "knots, fewer knots, or some smoothing"
    )
