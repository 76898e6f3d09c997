"""Cubic B-spline surfaces by their local stencil; see `dolens.optics.surfaces.b_spline`.

The record holds the knots in x, the knots in y, and the coefficients, rows along y.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted


@cache
def _spline(real: types.Type) -> tuple[Any, Any, Any]:
    """Compiled: the span of a coordinate, and its basis without and with second derivatives."""
    zero, one, three, six = real(0.0), real(1.0), real(3.0), real(6.0)

    @njit(**OPTIONS)
    def span(knots, count, u):  # noqa: ANN001, ANN202
        """First of the four coefficients that matter at u, from 0 to count - 4."""
        last = count - 4
        low, high = knots[3], knots[count]
        if not u > low:
            first = types.int64(0)
        elif not u < high:
            first = last
        else:
            # Knots are nearly even as a rule: guess, and walk.
            first = types.int64((u - low) / (high - low) * real(last + 1))
            first = last if first > last else first
            while first > 0 and u < knots[first + 3]:
                first -= 1
        while first < last and u >= knots[first + 4]:
            first += 1
        return first

    @njit(**OPTIONS)
    def basis(knots, u, low, high):  # noqa: ANN001, ANN202
        """Values and slopes of four basis functions; `knots` are those about the span."""
        a, b, c, d, e, f = knots[1], knots[2], knots[3], knots[4], knots[5], knots[6]
        inside = low if u < low else u
        inside = high if inside > high else inside
        beyond = u - inside
        after_a, after_b, after_c = inside - a, inside - b, inside - c
        to_d, to_e, to_f = d - inside, e - inside, f - inside
        width = one / (d - c)
        p0, p1 = to_d * width / (d - b), after_c * width / (e - c)
        q0 = to_d * p0 / (d - a)
        q1 = (after_b * p0 + to_e * p1) / (e - b)
        q2 = after_c * p1 / (f - c)
        d0, d1, d2, d3 = -three * q0, three * (q0 - q1), three * (q1 - q2), three * q2
        return (
            to_d * q0 + beyond * d0,
            after_a * q0 + to_e * q1 + beyond * d1,
            after_b * q1 + to_f * q2 + beyond * d2,
            after_c * q2 + beyond * d3,
            d0, d1, d2, d3,
        )  # fmt: skip

    @njit(**OPTIONS)
    def bend(knots, u, low, high):  # noqa: ANN001, ANN202
        """Second derivatives of the four; zero beyond the ends."""
        a, b, c, d, e, f = knots[1], knots[2], knots[3], knots[4], knots[5], knots[6]
        scale = zero if u < low or u > high else six
        width = one / (d - c)
        p0, p1 = (d - u) * width / (d - b), (u - c) * width / (e - c)
        r0, r1, r2 = -p0 / (d - a), (p0 - p1) / (e - b), p1 / (f - c)
        return -scale * r0, scale * (r0 - r1), scale * (r1 - r2), scale * r2

    return span, basis, bend


def b_spline_sag(real: types.Type) -> Callable[..., None]:
    """Sag, slopes, and the distance to the nearest edge of the knot rectangle."""
    span, basis, _ = _spline(real)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, 6144), carray(codes, 24)
        rows, columns = q[8], q[9]
        knots_x = carray(shifted(record, 24), 1 << 40)
        knots_y = carray(shifted(record, 28 + columns), 1 << 40)
        coefficients = shifted(record, 32 + columns + rows)
        x_low, x_high = knots_x[3], knots_x[columns]
        y_low, y_high = knots_y[3], knots_y[rows]
        for i in range(128):
            x, y = w[256 + i], w[384 + i]
            column, row = span(knots_x, columns, x), span(knots_y, rows, y)
            bx = basis(carray(shifted(record, 24 + column), 8), x, x_low, x_high)
            by = basis(carray(shifted(record, 28 + columns + row), 8), y, y_low, y_high)
            first = shifted(coefficients, row * columns + column)
            level = carray(shifted(first, columns), 4)[1]
            s = sx = sy = real(0.0)
            for j in range(4):
                c = carray(shifted(first, j * columns), 4)
                c0, c1, c2, c3 = c[0] - level, c[1] - level, c[2] - level, c[3] - level
                along = c0 * bx[0] + c1 * bx[1] + c2 * bx[2] + c3 * bx[3]
                slope = c0 * bx[4] + c1 * bx[5] + c2 * bx[6] + c3 * bx[7]
                s += along * by[j]
                sx += slope * by[j]
                sy += along * by[4 + j]
            w[512 + i], w[640 + i], w[768 + i] = level + s, sx, sy
            edge = min(min(x - x_low, x_high - x), min(y - y_low, y_high - y))
            w[896 + i] = edge

    return kernel


def b_spline_bend(real: types.Type) -> Callable[..., None]:
    """Slopes and second derivatives."""
    span, basis, bend = _spline(real)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, 6144), carray(codes, 24)
        rows, columns = q[8], q[9]
        knots_x = carray(shifted(record, 24), 1 << 40)
        knots_y = carray(shifted(record, 28 + columns), 1 << 40)
        coefficients = shifted(record, 32 + columns + rows)
        x_low, x_high = knots_x[3], knots_x[columns]
        y_low, y_high = knots_y[3], knots_y[rows]
        for i in range(128):
            x, y = w[256 + i], w[384 + i]
            column, row = span(knots_x, columns, x), span(knots_y, rows, y)
            around_x = carray(shifted(record, 24 + column), 8)
            around_y = carray(shifted(record, 28 + columns + row), 8)
            bx, by = basis(around_x, x, x_low, x_high), basis(around_y, y, y_low, y_high)
            ex, ey = bend(around_x, x, x_low, x_high), bend(around_y, y, y_low, y_high)
            first = shifted(coefficients, row * columns + column)
            level = carray(shifted(first, columns), 4)[1]
            sx = sy = sxx = sxy = syy = real(0.0)
            for j in range(4):
                c = carray(shifted(first, j * columns), 4)
                c0, c1, c2, c3 = c[0] - level, c[1] - level, c[2] - level, c[3] - level
                along = c0 * bx[0] + c1 * bx[1] + c2 * bx[2] + c3 * bx[3]
                slope = c0 * bx[4] + c1 * bx[5] + c2 * bx[6] + c3 * bx[7]
                curve = c0 * ex[0] + c1 * ex[1] + c2 * ex[2] + c3 * ex[3]
                sx += slope * by[j]
                sy += along * by[4 + j]
                sxx += curve * by[j]
                sxy += slope * by[4 + j]
                syy += along * ey[j]
            w[640 + i], w[768 + i] = sx, sy
            w[1024 + i], w[1152 + i], w[1280 + i] = sxx, sxy, syy

    return kernel


def b_spline_parameters(real: types.Type) -> Callable[..., None]:
    """Cotangents of the 16 coefficients at hand (rows 40 to 55), and where they lie (row 56).

    The place counts from the record's first coefficient.
    """
    span, basis, _ = _spline(real)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, 6144), carray(codes, 24)
        rows, columns = q[8], q[9]
        cot = carray(cotangents, 7296)
        knots_x = carray(shifted(record, 24), 1 << 40)
        knots_y = carray(shifted(record, 28 + columns), 1 << 40)
        x_low, x_high = knots_x[3], knots_x[columns]
        y_low, y_high = knots_y[3], knots_y[rows]
        for i in range(128):
            x, y = w[256 + i], w[384 + i]
            of_sag, of_sx, of_sy = w[1408 + i], w[1536 + i], w[1664 + i]
            column, row = span(knots_x, columns, x), span(knots_y, rows, y)
            bx = basis(carray(shifted(record, 24 + column), 8), x, x_low, x_high)
            by = basis(carray(shifted(record, 28 + columns + row), 8), y, y_low, y_high)
            for j in range(4):
                along, across = of_sag * by[j] + of_sy * by[4 + j], of_sx * by[j]
                for k in range(4):
                    cot[5120 + 128 * (4 * j + k) + i] = along * bx[k] + across * bx[4 + k]
            cot[7168 + i] = real(row * columns + column)

    return kernel
