"""Rays meet spheres and conics of revolution in the closed form of `dolens.kernels.conic`."""

import triton
import triton.language as tl

from dolens.kernels import conic
from dolens.kernels.cuda.arithmetic import GRAZING, clamp, divide, safe_sqrt
from dolens.kernels.cuda.layout import SHAPE
from dolens.kernels.cuda.translation import compiled

conic_distance = compiled(conic.conic_distance)
conic_gradient = compiled(conic.conic_gradient)
shape_cotangents = compiled(conic.shape_cotangents)


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
    gx, gy, gz = conic_gradient(c, k, x + t * l, y + t * m, t * n)
    inverse = divide(1.0, safe_sqrt(gx * gx + gy * gy + gz * gz))
    return t, gx * inverse, gy * inverse, gz * inverse, (squared > 0.0) & (gz > 0.0)


@triton.jit
def gradient_and_second(c, k, x, y, z):
    """Return g, 1/|g|, and the diagonal of the second derivatives of F."""
    gx, gy, gz = conic_gradient(c, k, x, y, z)
    inverse = divide(1.0, safe_sqrt(gx * gx + gy * gy + gz * gz))
    return gx, gy, gz, inverse, -c + tl.zeros_like(x), -(1.0 + k) * c + tl.zeros_like(x)
