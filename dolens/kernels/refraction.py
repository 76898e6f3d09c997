"""Refraction and deflection by a phase, once for PyTorch, Numba and Triton, with their adjoints."""

from dolens.kernels.operations import Number, clamp, divide, fma, safe_sqrt, where
from dolens.kernels.table import LONGEST, LONGEST_WAVEVECTOR, STEEPEST


def refract(
    l: Number, m: Number, n: Number, nx: Number, ny: Number, nz: Number,  # noqa: E741
    ratio: Number, sense: Number,
) -> tuple[Number, Number, Number, Number]:  # fmt: skip
    """Return the direction behind a surface, d' = μ·d + (s·cos t - μ·cos i)·N, and cos²t = 1 -
    μ²(1 - cos²i), which is positive without total reflection.

    Args:
        l: direction cosines, and m and n.
        m: along y.
        n: along z.
        nx: the unit normal towards +z, and ny and nz.
        ny: along y.
        nz: along z.
        ratio: μ, index before over index after, in the order of the light's travel.
        sense: s, the sign of d'·N.
    """
    # Only rays that missed have |cos i| > 1; two keeps them finite and rounding unclipped.
    cosine = clamp(fma(n, nz, fma(m, ny, l * nx)), LONGEST)
    squared = (1.0 - ratio * ratio) + (ratio * ratio) * (cosine * cosine)
    along = sense * safe_sqrt(squared) - ratio * cosine
    # Rays that missed have no unit normal; a direction that grew would overflow float32 later.
    return (
        clamp(fma(along, nx, ratio * l), LONGEST),
        clamp(fma(along, ny, ratio * m), LONGEST),
        clamp(fma(along, nz, ratio * n), LONGEST),
        squared,
    )


def refract_adjoint(
    a: Number, b: Number, c: Number, l: Number, m: Number, n: Number,  # noqa: E741
    nx: Number, ny: Number, nz: Number, out_l: Number, out_m: Number, out_n: Number,
    ratio: Number, per_index: Number,
) -> tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]:  # fmt: skip
    """Return the cotangents of direction, normal and both indices from (a, b, c), that of d', and
    1/cos i.

    d' = μ·d + Γ·N with Γ = s·cos t - μ·cos i, and s·cos t = d'·N.  `per_index` is one over the
    index in front.  One division serves both cosines.
    """
    cosine = l * nx + m * ny + n * nz
    inside = out_l * nx + out_m * ny + out_n * nz
    both = divide(1.0, cosine * inside)
    along = inside - ratio * cosine
    of_along = a * nx + b * ny + c * nz
    refracted = ratio * both * cosine
    of_cosine = of_along * (ratio * refracted * cosine - ratio)
    of_ratio = (a * l + b * m + c * n) - of_along * (refracted * (1.0 - cosine * cosine) + cosine)
    of_before = of_ratio * ratio * per_index
    return (
        ratio * a + of_cosine * nx,
        ratio * b + of_cosine * ny,
        ratio * c + of_cosine * nz,
        along * a + of_cosine * l,
        along * b + of_cosine * m,
        along * c + of_cosine * n,
        of_before,
        -of_before * ratio,
        both * inside,
    )


def deflect(
    gx: Number, gy: Number, l: Number, m: Number, n: Number,  # noqa: E741
    nx: Number, ny: Number, nz: Number, ratio: Number, sense: Number,
) -> tuple[Number, Number, Number, Number]:  # fmt: skip
    """Return the direction behind a phase, and a number that is positive where its order is not
    evanescent; see `dolens.optics.surfaces.phase`.

    Args:
        gx: g, what the phase adds along the surface, and gy.
        gy: along y.
        l: to `sense`: as of `refract`.
    """
    bx, by, az = ratio * l, ratio * m, ratio * n
    ax, ay = bx + gx, by + gy
    along = clamp(ax * nx + ay * ny + az * nz, LONGEST_WAVEVECTOR)
    # 1 - |a|² without the cancellation of |d|² = 1: Snell's law where there is no phase.
    more = gx * (ax + bx) + gy * (ay + by)
    squared = (1.0 - ratio * ratio) - more + along * along
    steep = where(gx < 0.0, -gx, gx) + where(gy < 0.0, -gy, gy)
    squared = where(steep < STEEPEST, squared, -1.0)
    change = sense * safe_sqrt(squared) - along
    # Directions of rays that ended stay in single precision's range.
    return (
        clamp(fma(change, nx, ax), LONGEST),
        clamp(fma(change, ny, ay), LONGEST),
        clamp(fma(change, nz, az), LONGEST),
        squared,
    )


def deflect_adjoint(
    gx: Number, gy: Number, l: Number, m: Number, n: Number,  # noqa: E741
    nx: Number, ny: Number, nz: Number, out_l: Number, out_m: Number, out_n: Number,
    a: Number, b: Number, c: Number, ratio: Number, per_index: Number,
) -> tuple[
    Number, Number, Number, Number, Number, Number, Number, Number, Number, Number
]:  # fmt: skip
    """Return the cotangents of g, the direction, the normal and both indices from (a, b, c), that
    of d'; g has one over the index behind in it, which counts here.

    d' = a + Γ·N with a = μ·d + g, Γ = D - a·N and D = d'·N, where D² = 1 - μ² - g·(2μ·d + g) +
    (a·N)².  So with (ā, b̄, c̄) = d̄', Γ̄ = d̄'·N, e = Γ̄/D and t = d̄' + (e·(a·N) - Γ̄)·N the
    cotangents are d̄ = μ(t - e·g), ḡ = t - e·a, μ̄ = d·t - e(μ + g·d), N̄ = Γ·d̄' + (e·(a·N) - Γ̄)·a.
    """
    ax, ay, az = ratio * l + gx, ratio * m + gy, ratio * n
    inside = out_l * nx + out_m * ny + out_n * nz
    along = ax * nx + ay * ny + az * nz
    change = inside - along
    of_change = a * nx + b * ny + c * nz
    e = divide(of_change, inside)
    of_along = e * along - of_change
    tx, ty, tz = a + of_along * nx, b + of_along * ny, c + of_along * nz
    of_gx, of_gy = tx - e * ax, ty - e * ay
    of_ratio = (l * tx + m * ty + n * tz) - e * (ratio + gx * l + gy * m)
    return (
        of_gx,
        of_gy,
        ratio * (tx - e * gx),
        ratio * (ty - e * gy),
        ratio * tz,
        change * a + of_along * ax,
        change * b + of_along * ay,
        change * c + of_along * az,
        of_ratio * ratio * per_index,
        -(of_ratio * ratio + gx * of_gx + gy * of_gy) * ratio * per_index,
    )
