"""Cubic basis functions of one span stand once, for PyTorch, Numba and Triton; see
`dolens.kernels.shapes` for how they are written.

Past the ends of a spline or a grid, each function goes on along its tangent.
"""

from dolens.kernels.operations import Number, divide, fma, where, zero

Four = tuple[Number, Number, Number, Number]
Eight = tuple[Number, Number, Number, Number, Number, Number, Number, Number]


def b_splines(
    a: Number, b: Number, c: Number, d: Number, e: Number, f: Number,
    u: Number, low: Number, high: Number,
) -> Eight:  # fmt: skip
    """Return values and slopes (1/mm) of the four cubic B-splines of the span [c, d] at u.

    By Cox's and de Boor's recurrence, whose denominators span at least c to d > c.  The derivative
    shares its terms: N' = 3(Q_k/d_k - Q_(k+1)/d_(k+1)) with the quadratic B-splines Q (de Boor, A
    Practical Guide to Splines, ch. X).

    Args:
        a: to f: the six knots about the span, mm.
        u: mm.
        low: where the spline begins, mm.
        high: where it ends.
    """
    inside = where(u < low, low, where(u > high, high, u))
    beyond = u - inside
    after_a, after_b, after_c = inside - a, inside - b, inside - c
    to_d, to_e, to_f = d - inside, e - inside, f - inside
    # Linear, quadratic and cubic B-splines; p and q are over the widths of their own supports.
    width = divide(1.0, d - c)
    p0, p1 = divide(to_d * width, d - b), divide(after_c * width, e - c)
    q0 = divide(to_d * p0, d - a)
    q1 = divide(fma(to_e, p1, after_b * p0), e - b)
    q2 = divide(after_c * p1, f - c)
    s0, s1, s2, s3 = -3.0 * q0, 3.0 * (q0 - q1), 3.0 * (q1 - q2), 3.0 * q2
    return (
        fma(beyond, s0, to_d * q0),
        fma(beyond, s1, fma(to_e, q1, after_a * q0)),
        fma(beyond, s2, fma(to_f, q2, after_b * q1)),
        fma(beyond, s3, after_c * q2),
        s0,
        s1,
        s2,
        s3,
    )


def b_splines_second(
    a: Number, b: Number, c: Number, d: Number, e: Number, f: Number,
    u: Number, low: Number, high: Number,
) -> Four:  # fmt: skip
    """Return the second derivatives (1/mm²) of the four; zero beyond the ends."""
    inside = where(u < low, low, where(u > high, high, u))
    scale = where((u < low) | (u > high), zero(u), zero(u) + 6.0)
    width = divide(1.0, d - c)
    p0, p1 = divide((d - inside) * width, d - b), divide((inside - c) * width, e - c)
    r0, r1, r2 = divide(-p0, d - a), divide(p0 - p1, e - b), divide(p1, f - c)
    return -scale * r0, scale * (r0 - r1), scale * (r1 - r2), scale * r2


def hermite(t: Number, spacing: Number) -> Eight:
    """Return weights of value and slope at a cell's lower node, and at its upper one, by Hermite's
    cubics, and their derivatives (1/mm).

    Args:
        t: place in the cell, 0 at the lower node and 1 at the upper one.
        spacing: of the nodes, mm.
    """
    held = where(t < 0.0, zero(t), where(t > 1.0, zero(t) + 1.0, t))
    past, s = (t - held) * spacing, 1.0 - held
    bell = divide(6.0 * held * s, spacing + zero(t))
    d1, d3 = s * (s - 2.0 * held), held * (held - 2.0 * s)
    return (
        s * s * (1.0 + 2.0 * held) - past * bell,
        held * s * s * spacing + past * d1,
        held * held * (1.0 + 2.0 * s) + past * bell,
        past * d3 - held * held * s * spacing,
        -bell,
        d1,
        bell,
        d3,
    )


def hermite_second(t: Number, spacing: Number) -> Four:
    """Return the second derivatives of the four weights (1/mm² of values); zero beyond the grid."""
    inside = where((t < 0.0) | (t > 1.0), zero(t), zero(t) + 1.0)
    inverse = divide(inside, spacing + zero(t))
    bend = divide(6.0 * (2.0 * t - 1.0) * inverse, spacing + zero(t))
    return bend, (6.0 * t - 4.0) * inverse, -bend, (6.0 * t - 2.0) * inverse
