"""Rays meet spheres and conics in the closed form of `dolens.optics.surfaces.conic`.

F = z - c(x² + y² + (1+k)z²)/2 has the gradient g = (-cx, -cy, 1 - (1+k)cz), a unit vector on a
sphere, where k = 0.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import GRAZING, add_sum, clamp, divide, safe_sqrt
from dolens.kernels.cuda.layout import SHAPE


@triton.jit
def conic_distance(c, a, x, y, l, m, n, sense):
    """Return the distance from the vertex plane to a conic, and D; see `optics.surfaces.conic`."""
    f = c * (x * x + y * y)
    g = n - c * (l * x + m * y)
    squared = g * g - a * f
    root = safe_sqrt(squared)
    along = sense * g
    near = along + root
    near = divide(f, tl.where(near > GRAZING, near, GRAZING))
    far = divide(along - root, tl.where(tl.abs(a) < 1e-15, 1.0, a))
    return sense * tl.where(along > 0.0, near, far), squared


@triton.jit
def sphere_intersect(record, x, y, l, m, n, sense, limit):
    """Return the distance from the vertex plane, the unit normal there, and whether it is met."""
    c = tl.load(record + SHAPE)
    f = c * (x * x + y * y)
    g = n - c * (l * x + m * y)
    squared = g * g - c * f
    near = sense * g + safe_sqrt(squared)
    t = clamp(divide(sense * f, tl.where(near > GRAZING, near, GRAZING)), limit)
    nz = 1.0 - c * (t * n)
    return t, -c * (x + t * l), -c * (y + t * m), nz, (squared > 0.0) & (nz > 0.0)


@triton.jit
def conic_intersect(record, x, y, l, m, n, sense, limit):
    """Return the distance from the vertex plane, the unit normal there, and whether it is met."""
    c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
    t, squared = conic_distance(c, c + (c * k) * (n * n), x, y, l, m, n, sense)
    t = clamp(t, limit)
    gx, gy, gz = -c * (x + t * l), -c * (y + t * m), 1.0 - (1.0 + k) * c * (t * n)
    inverse = divide(1.0, safe_sqrt(gx * gx + gy * gy + gz * gz))
    return t, gx * inverse, gy * inverse, gz * inverse, (squared > 0.0) & (gz > 0.0)


@triton.jit
def conic_gradient(c, k, x, y, z):
    """Return g, 1/|g|, and the diagonal of the second derivatives of F."""
    e = 1.0 + k
    gx, gy, gz = -c * x, -c * y, 1.0 - e * c * z
    inverse = divide(1.0, safe_sqrt(gx * gx + gy * gy + gz * gz))
    return gx, gy, gz, inverse, -c + tl.zeros_like(x), -e * c + tl.zeros_like(x)


@triton.jit
def conic_curvature_cotangent(k, x, y, z, along, ux, uy, uz):
    """Return each ray's cotangent of c, from -`along`, that of F, and (ux, uy, uz), that of g."""
    e = 1.0 + k
    return 0.5 * along * (x * x + y * y + e * z * z) - (ux * x + uy * y + e * uz * z)


@triton.jit
def conic_sums(record, sums, x, y, z, along, ux, uy, uz, alive):
    """Add the cotangents of c and k."""
    c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
    add_sum(sums + SHAPE, conic_curvature_cotangent(k, x, y, z, along, ux, uy, uz), alive)
    add_sum(sums + SHAPE + 1, c * z * (0.5 * along * z - uz), alive)
