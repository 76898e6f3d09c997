"""Sags of surfaces in 80-digit arithmetic, each from the definition in the literature.

Zernike polynomials come from their factorial sums and the angle, Q_con from the hypergeometric
Jacobi polynomials, Q_bfs from the orthogonality of slopes: nothing here is dolens's recurrence.
"""

import math
from functools import lru_cache

import mpmath

mp = mpmath.mp.clone()  # a precision of its own
mp.dps = 80


def even_asphere_sag(p, x, y):
    """Conic plus even powers of r; None beyond the conic."""
    r2 = x**2 + y**2
    conic = _conic(p["curvature"], p.get("conic", mp.mpf(0)), r2)
    if conic is None:
        return None
    return conic + sum(a * r2 ** (int(n[1:]) // 2) for n, a in p.items() if _even(n))


def _even(name):
    return name[0] == "a" and name[1:].isdigit() and int(name[1:]) % 2 == 0


def _conic(c, k, r2):
    squared = 1 - (1 + k) * c**2 * r2
    return None if squared < 0 else c * r2 / (1 + mp.sqrt(squared))


def _odd_asphere(p, x, y):
    base = even_asphere_sag(p, x, y)
    if base is None:
        return None
    r = mp.sqrt(x**2 + y**2)
    odd = {int(n[1:]): a for n, a in p.items() if n[0] == "a" and not _even(n)}
    return base + sum(a * r**power for power, a in odd.items())


def _biconic(p, x, y):
    cx, cy = p["curvature_x"], p["curvature_y"]
    squared = 1 - (1 + p["conic_x"]) * (cx * x) ** 2 - (1 + p["conic_y"]) * (cy * y) ** 2
    return None if squared < 0 else (cx * x**2 + cy * y**2) / (1 + mp.sqrt(squared))


def _toroid(p, x, y):
    """The circle through (0, f(y)) about the axis at the distance 1/c_x."""
    curve = {"curvature": p["curvature_y"], "conic": p["conic_y"]}
    f = even_asphere_sag(curve | {n: a for n, a in p.items() if _even(n)}, mp.mpf(0), y)
    c = p["curvature_x"]
    if f is None or c == 0:
        return f
    radius = 1 / c
    squared = (radius - f) ** 2 - x**2
    if squared < 0 or (radius - f) * c < 0:
        return None
    return radius - mp.sign(c) * mp.sqrt(squared)


def _radial(n, m, rho):
    """R_n^m by its factorial sum (Born and Wolf, 9.2.1)."""
    return rho**m * mp.polyval(_radial_coefficients(n, m), rho**2)


@lru_cache(maxsize=512)
def _radial_coefficients(n, m):
    """Of falling powers of ρ², from (n - m)/2 to 0: whole numbers."""
    half, f = (n - m) // 2, math.factorial
    return [
        (-1) ** s * f(n - s) // (f(s) * f((n + m) // 2 - s) * f(half - s)) for s in range(half + 1)
    ]


@lru_cache(maxsize=512)
def noll_order(number):
    """(n, m), m negative for a sine: by counting through Noll's table."""
    j, n = 0, 0
    while True:
        for m in range(n % 2, n + 1, 2):
            for _ in range(2 if m else 1):
                j += 1
                if j == number:
                    return n, (m if m == 0 or j % 2 == 0 else -m)
        n += 1


@lru_cache(maxsize=512)
def fringe_order(number):
    """(n, m), m negative for a sine: by counting through the University of Arizona's table."""
    if number == 37:
        return 12, 0
    j, half = 0, 0
    while True:
        for m in range(half, -1, -1):
            for sign in (1, -1) if m else (1,):
                j += 1
                if j == number:
                    return 2 * half - m, sign * m
        half += 1


def zernike(order, normalised, number, rho, angle):
    """A Zernike polynomial at polar coordinates."""
    n, m = order(number)
    value = _radial(n, abs(m), rho)
    value *= mp.cos(m * angle) if m >= 0 else mp.sin(-m * angle)
    return value * (mp.sqrt((n + 1) * (2 if m else 1)) if normalised else 1)


def _zernike_sag(order, normalised):
    def sag(p, x, y):
        base = even_asphere_sag(p, x, y)
        if base is None:
            return None
        u, v = x - p["decenter_x"], y - p["decenter_y"]
        rho, angle = mp.hypot(u, v) / p["normalization_radius"], mp.atan2(v, u)
        terms = {int(n[1:]): a for n, a in p.items() if n[0] == "z"}
        return base + mp.fsum(
            a * zernike(order, normalised, j, rho, angle) for j, a in terms.items()
        )

    return sag


def _forbes_terms(p):
    return {int(n[1:]): a for n, a in p.items() if n[0] == "q"}


def _q_con(p, x, y):
    base = even_asphere_sag(p, x, y)
    if base is None:
        return None
    q = (x**2 + y**2) / p["normalization_radius"] ** 2
    return base + q**2 * mp.fsum(a * q_con_polynomial(m, q) for m, a in _forbes_terms(p).items())


def q_con_polynomial(m, q):
    """P_m^(0, 4)(2q - 1) as the sum over powers of q - 1 (Abramowitz and Stegun 22.5.42)."""
    return mp.polyval(_jacobi_coefficients(m), q - 1)


@lru_cache(maxsize=64)
def _jacobi_coefficients(m):
    """Of falling powers of q - 1: whole numbers."""
    return [math.comb(m, s) * math.comb(m + s + 4, s) for s in range(m, -1, -1)]


def _q_bfs(p, x, y):
    """The departure along the conic's normal, from the conic's slope."""
    c, k, r2 = p["curvature"], p["conic"], x**2 + y**2
    base = _conic(c, k, r2)
    if base is None:
        return None
    q = r2 / p["normalization_radius"] ** 2
    total = mp.fsum(
        a * mp.polyval(q_bfs_polynomial(m)[::-1], q) for m, a in _forbes_terms(p).items()
    )
    slope_squared = c**2 * r2 / (1 - (1 + k) * c**2 * r2)
    return base + q * (1 - q) * mp.sqrt(1 + slope_squared) * total


@lru_cache(maxsize=64)
def q_bfs_polynomial(m):
    """Coefficients of Q_m^bfs by rising powers of q = u², by Gram and Schmidt.

    The slopes of u²(1 - u²)·Q_m(u²) are orthonormal in the mean over θ, u = sin θ (Forbes 2007);
    Q_m(0) > 0.
    """
    found = [mp.mpf(0)] * m + [mp.mpf(1)]
    for lower in range(m):
        q = q_bfs_polynomial(lower)
        weight = _mean_of_slopes(found, q)
        found = [a - weight * (q[i] if i < len(q) else 0) for i, a in enumerate(found)]
    size = mp.sqrt(_mean_of_slopes(found, found))
    return [a * mp.sign(found[0]) / size for a in found]


def _slope_polynomial(q):
    """Half the slope over u: d/dx of x(1 - x)·Q(x)."""
    times = [mp.mpf(0)] * (len(q) + 2)
    for i, a in enumerate(q):
        times[i + 1] += a
        times[i + 2] -= a
    return [i * a for i, a in enumerate(times)][1:]


def _mean_of_slopes(first, second):
    """Mean over θ of 4x·D1(x)·D2(x) with x = sin²θ; that of sin^(2n) θ is C(2n, n)/4^n."""
    return 4 * mp.fsum(
        a * b * mp.binomial(2 * (i + j + 1), i + j + 1) / mp.mpf(4) ** (i + j + 1)
        for i, a in enumerate(_slope_polynomial(first))
        for j, b in enumerate(_slope_polynomial(second))
    )


SAGS = {
    "odd_asphere": _odd_asphere,
    "biconic": _biconic,
    "toroid": _toroid,
    "zernike_standard": _zernike_sag(noll_order, True),
    "zernike_fringe": _zernike_sag(fringe_order, False),
    "q_con": _q_con,
    "q_bfs": _q_bfs,
}
