"""The closed form of a conic of revolution, once for PyTorch, Numba and Triton; of a sphere k = 0.

F = z - c(x² + y² + (1+k)z²)/2 has the gradient g = (-cx, -cy, 1 - (1+k)cz), a unit vector on a
sphere.
"""

from dolens.kernels.operations import Number, divide, fma, safe_sqrt, where
from dolens.kernels.table import GRAZING

FLAT = 1e-15  # 1/mm


def quadratic_root(f: Number, g: Number, a: Number, sense: Number) -> tuple[Number, Number]:
    """Return the root t of A·t² - 2G·t + F = 0 with the sign `sense` of G - A·t, and D = G² - AF.

    t = F/(G + s√D) has no cancellation where s·G > 0, and holds for A = 0; where s·G < 0 the other
    form, (G - s√D)/A, is the one without.
    """
    squared = g * g - a * f
    root = safe_sqrt(squared)
    along = sense * g
    near = along + root
    near = divide(f, where(near > GRAZING, near, GRAZING))
    # Where A is this small the far root is out of any lens's reach, and 1/A² out of float32's.
    size = where(a < 0.0, -a, a)
    far = divide(along - root, where(size < FLAT, 1.0, a))
    return sense * where(along > 0.0, near, far), squared


def conic_distance(
    c: Number, a: Number, x: Number, y: Number, l: Number, m: Number, n: Number,  # noqa: E741
    sense: Number,
) -> tuple[Number, Number]:  # fmt: skip
    """Return the distance from the vertex plane to a conic (mm), on the crossing in the direction
    of `sense`, and D, which is positive where the conic is met.

    Along the ray, A·t² - 2G·t + F = 0 with F = c(x² + y²), G = n - c(lx + my) and A = c(1 + k·n²).
    At a root, direction · gradient = G - A·t = ±√D, so that the sign of the root is the sense of
    crossing.

    Args:
        c: curvature, 1/mm.
        a: A.
        x: of the ray on the vertex plane, mm; and y.
        y: mm.
        l: its direction cosines, and m and n.
        m: along y.
        n: along z.
        sense: s.
    """
    f = c * fma(y, y, x * x)
    g = n - c * fma(m, y, l * x)
    return quadratic_root(f, g, a, sense)


def conic_gradient(
    c: Number, k: Number, x: Number, y: Number, z: Number
) -> tuple[Number, Number, Number]:
    """Return g at a point of the conic."""
    return -c * x, -c * y, 1.0 - (1.0 + k) * c * z


def shape_cotangents(
    c: Number, k: Number, x: Number, y: Number, z: Number,
    along: Number, ux: Number, uy: Number, uz: Number,
) -> tuple[Number, Number]:  # fmt: skip
    """Return the cotangents of c and k, from -`along`, that of F, and (ux, uy, uz), that of g."""
    e = 1.0 + k
    half = 0.5 * along
    return (
        half * (x * x + y * y + e * z * z) - (ux * x + uy * y + e * uz * z),
        c * z * (half * z - uz),
    )
