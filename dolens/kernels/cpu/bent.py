"""Rays bend in a gradient-index medium; see `dolens.optics.gradients`, whose steps these are.

The adjoint takes rays back by the same steps, which return to the beginning but for rounding, so
that nothing is kept on the way.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import carray, njit, types
from torch import Tensor

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import UNBOUNDED
from dolens.kernels.cpu.program import REAL
from dolens.kernels.cpu.threads import spread, thread_count
from dolens.kernels.table import DRIFTS, KICKS

# Places in the job, an array of integers: addresses of arrays;
MOTION, TIME, BASE, PROFILE, COTANGENT, OF_BASE, OF_PROFILE, WORK = range(8)
# rays, steps, whether n² has the profile, numbers from one ray's base to the next's, whether the
# profile has derivatives.
RAYS, STEPS, SQUARED, BASE_STEP, VARIES = range(8, 13)
_JOB = 16
_BLOCK = 64
# Coefficients of r², r⁴, ..., r¹²; z, ..., z⁴; x, x²; y, y².
COEFFICIENTS = 14
_PARTS = 7  # of a motion: position, optical direction, path
# Rows of a block's memory: a motion, a step, the base; its tangents or cotangents, and the base's;
# cotangents of the coefficients.
_H, _BASE, _C, _OF_BASE, _OF_PROFILE = 7, 8, 9, 16, 17
_WORK = (17 + COEFFICIENTS) * _BLOCK
_INLINED = {**OPTIONS, "forceinline": True}
_STAGES = len(DRIFTS)


@cache
def _profile(real: types.Type) -> tuple[Any, Any, Any, Any]:
    """Compile the profile's ½n² and ½∇n², and what derivatives need of it.

    Coefficients come as a tuple: in memory that is also written to they would be read at each ray.
    """
    half, two, three, four = (real(v) for v in (0.5, 2.0, 3.0, 4.0))
    five, six, twelve, twenty = (real(v) for v in (5.0, 6.0, 12.0, 20.0))
    thirty = real(30.0)

    @njit(**_INLINED)
    def slopes(c, x, y, z):  # noqa: ANN001, ANN202
        """Return the profile, its gradient, and its slope over r²."""
        u = x * x + y * y
        radial = ((((c[5] * u + c[4]) * u + c[3]) * u + c[2]) * u + c[1]) * u + c[0]
        slope = ((((six * c[5] * u + five * c[4]) * u + four * c[3]) * u + three * c[2]) * u) + (
            two * c[1]
        )
        slope = slope * u + c[0]
        axial = ((c[9] * z + c[8]) * z + c[7]) * z + c[6]
        along = ((four * c[9] * z + three * c[8]) * z + two * c[7]) * z + c[6]
        value = (radial * u + axial * z) + ((c[11] * x + c[10]) * x + (c[13] * y + c[12]) * y)
        gx = two * (slope + c[11]) * x + c[10]
        gy = two * (slope + c[13]) * y + c[12]
        return value, gx, gy, along, slope, u

    @njit(**_INLINED)
    def force(c, base, squared, x, y, z):  # noqa: ANN001, ANN202
        """Return ½n² and ½∇n²."""
        value, gx, gy, gz, _, _ = slopes(c, x, y, z)
        if squared:
            return half * (base * base + value), half * gx, half * gy, half * gz
        n = base + value
        return half * n * abs(n), n * gx, n * gy, n * gz

    @njit(**_INLINED)
    def tangent(c, base, squared, x, y, z, a, b, d, e, varies, dc):  # noqa: ANN001, ANN202
        """Return ½n² and ½∇n², and their tangents along (a, b, d), e of the base and dc."""
        value, gx, gy, gz, slope, u = slopes(c, x, y, z)
        bend = (((thirty * c[5] * u + twenty * c[4]) * u + twelve * c[3]) * u + six * c[2]) * u
        across = four * (bend + two * c[1]) * (x * a + y * b)
        hx = two * (slope + c[11]) * a + across * x
        hy = two * (slope + c[13]) * b + across * y
        hz = ((twelve * c[9] * z + six * c[8]) * z + two * c[7]) * d
        along = gx * a + gy * b + gz * d
        if varies:
            value_, gx_, gy_, gz_, _, _ = slopes(dc, x, y, z)
            hx, hy, hz, along = hx + gx_, hy + gy_, hz + gz_, along + value_
        if squared:
            phi, of_phi = half * (base * base + value), half * along + base * e
            fx, fy, fz = half * gx, half * gy, half * gz
            return phi, fx, fy, fz, of_phi, half * hx, half * hy, half * hz
        n, s = base + value, along + e
        return (
            half * n * abs(n), n * gx, n * gy, n * gz, n * s, s * gx + n * hx, s * gy + n * hy,
            s * gz + n * hz,
        )  # fmt: skip

    @njit(**_INLINED)
    def adjoint(c, base, squared, x, y, z, a, b, d, p):  # noqa: ANN001, ANN202
        """Return ½∇n², the cotangent of the position of ½∇n²·(a, b, d) + ½n²·p, and of the base;
        then those of the profile, and by what ∇ of it is multiplied along (a, b, d).
        """
        value, gx, gy, gz, slope, u = slopes(c, x, y, z)
        bend = (((thirty * c[5] * u + twenty * c[4]) * u + twelve * c[3]) * u + six * c[2]) * u
        across = four * (bend + two * c[1]) * (x * a + y * b)
        hx = two * (slope + c[11]) * a + across * x
        hy = two * (slope + c[13]) * b + across * y
        hz = ((twelve * c[9] * z + six * c[8]) * z + two * c[7]) * d
        if squared:
            fx, fy, fz = half * gx, half * gy, half * gz
            return (
                fx, fy, fz, half * hx + p * fx, half * hy + p * fy, half * hz + p * fz, p * base,
                half * p, half,
            )  # fmt: skip
        n = base + value
        along = gx * a + gy * b + gz * d
        fx, fy, fz = n * gx, n * gy, n * gz
        return (
            fx, fy, fz, gx * along + n * hx + p * fx, gy * along + n * hy + p * fy,
            gz * along + n * hz + p * fz, along + p * n, along + p * n, n,
        )  # fmt: skip

    @njit(**_INLINED)
    def gather(w, i, k, x, y, z, a, b, d, g, m):  # noqa: ANN001, ANN202
        """Add k times the cotangents of a ray's coefficients: g·term + m·∇term·(a, b, d)."""
        u, v, g = x * x + y * y, k * m * two * (x * a + y * b), k * g
        a, b, d = k * m * a, k * m * b, k * m * d
        power, order = real(1.0), real(1.0)
        for row in range(6):
            w[(_OF_PROFILE + row) * _BLOCK + i] += power * (g * u + order * v)
            power, order = power * u, order + real(1.0)
        power, order = real(1.0), real(1.0)
        for row in range(6, 10):
            w[(_OF_PROFILE + row) * _BLOCK + i] += power * (g * z + order * d)
            power, order = power * z, order + real(1.0)
        w[(_OF_PROFILE + 10) * _BLOCK + i] += g * x + a
        w[(_OF_PROFILE + 11) * _BLOCK + i] += x * (g * x + two * a)
        w[(_OF_PROFILE + 12) * _BLOCK + i] += g * y + b
        w[(_OF_PROFILE + 13) * _BLOCK + i] += y * (g * y + two * b)

    return force, tangent, adjoint, gather


@cache
def _stages(real: types.Type) -> tuple[Any, Any, Any, Any]:
    """Compile how a block of rays begins, a drift and a kick, their tangents and their adjoint.

    Rows of a block follow each other at a distance that is known, so that several rays are taken at
    a time.
    """
    at = real_at(real)
    force, tangent, adjoint, gather = _profile(real)
    half, zero = real(0.5), real(0.0)

    @njit(**OPTIONS)
    def fill(job, block, address, count, first):  # noqa: ANN001, ANN202
        """Fill rows of a block with numbers of rays (rows of `count`), zero beyond the last."""
        rows, work = carray(at(address), UNBOUNDED), carray(block, UNBOUNDED)
        for row in range(_PARTS):
            for i in range(_BLOCK):
                ray = first + i
                work[row * _BLOCK + i] = rows[row * count + ray] if ray < count else zero

    @njit(**OPTIONS)
    def begin_block(job_, block, first, both):  # noqa: ANN001, ANN202
        """Fill a block with motions, steps and bases, and with tangents or cotangents."""
        job, w = carray(job_, _JOB), carray(block, _WORK)
        count = job[RAYS]
        times, bases = carray(at(job[TIME]), UNBOUNDED), carray(at(job[BASE]), UNBOUNDED)
        fill(job, block, job[MOTION], count, first)
        if both:
            fill(job, shifted(block, _C * _BLOCK), job[COTANGENT], count, first)
        for i in range(_BLOCK):
            ray = min(first + i, count - 1)
            w[_H * _BLOCK + i] = times[ray] / real(job[STEPS])
            w[_BASE * _BLOCK + i] = bases[ray * job[BASE_STEP]]

    @njit(**OPTIONS)
    def onwards(block, c, squared, drift, kick, varies, dc):  # noqa: ANN001, ANN202
        w = carray(block, _WORK)
        for i in range(_BLOCK):
            h, base = w[_H * _BLOCK + i], w[_BASE * _BLOCK + i]
            u, v, k = w[3 * _BLOCK + i], w[4 * _BLOCK + i], w[5 * _BLOCK + i]
            d = drift * h
            x, y, z = w[i] + d * u, w[_BLOCK + i] + d * v, w[2 * _BLOCK + i] + d * k
            phi, fx, fy, fz = force(c, base, squared, x, y, z)
            path = w[6 * _BLOCK + i] + half * d * (u * u + v * v + k * k)
            d = kick * h
            w[i], w[_BLOCK + i], w[2 * _BLOCK + i] = x, y, z
            w[3 * _BLOCK + i], w[4 * _BLOCK + i] = u + d * fx, v + d * fy
            w[5 * _BLOCK + i], w[6 * _BLOCK + i] = k + d * fz, path + d * phi

    @njit(**OPTIONS)
    def along(block, c, squared, drift, kick, varies, dc):  # noqa: ANN001, ANN202
        w = carray(block, _WORK)
        for i in range(_BLOCK):
            h, base, e = w[_H * _BLOCK + i], w[_BASE * _BLOCK + i], w[_OF_BASE * _BLOCK + i]
            u, v, k = w[3 * _BLOCK + i], w[4 * _BLOCK + i], w[5 * _BLOCK + i]
            du, dv = w[(_C + 3) * _BLOCK + i], w[(_C + 4) * _BLOCK + i]
            dk = w[(_C + 5) * _BLOCK + i]
            d = drift * h
            x, y, z = w[i] + d * u, w[_BLOCK + i] + d * v, w[2 * _BLOCK + i] + d * k
            a, b = w[_C * _BLOCK + i] + d * du, w[(_C + 1) * _BLOCK + i] + d * dv
            s = w[(_C + 2) * _BLOCK + i] + d * dk
            phi, fx, fy, fz, of_phi, gx, gy, gz = tangent(
                c, base, squared, x, y, z, a, b, s, e, varies, dc
            )
            path = w[6 * _BLOCK + i] + half * d * (u * u + v * v + k * k)
            of_path = w[(_C + 6) * _BLOCK + i] + d * (u * du + v * dv + k * dk)
            d = kick * h
            w[i], w[_BLOCK + i], w[2 * _BLOCK + i] = x, y, z
            w[3 * _BLOCK + i], w[4 * _BLOCK + i] = u + d * fx, v + d * fy
            w[5 * _BLOCK + i], w[6 * _BLOCK + i] = k + d * fz, path + d * phi
            w[_C * _BLOCK + i], w[(_C + 1) * _BLOCK + i] = a, b
            w[(_C + 2) * _BLOCK + i], w[(_C + 3) * _BLOCK + i] = s, du + d * gx
            w[(_C + 4) * _BLOCK + i], w[(_C + 5) * _BLOCK + i] = dv + d * gy, dk + d * gz
            w[(_C + 6) * _BLOCK + i] = of_path + d * of_phi

    @njit(**OPTIONS)
    def backwards(block, c, squared, drift, kick, varies):  # noqa: ANN001, ANN202
        w = carray(block, _WORK)
        for i in range(_BLOCK):
            h, base = w[_H * _BLOCK + i], w[_BASE * _BLOCK + i]
            x, y, z = w[i], w[_BLOCK + i], w[2 * _BLOCK + i]
            a, b, e = (
                w[(_C + 3) * _BLOCK + i], w[(_C + 4) * _BLOCK + i], w[(_C + 5) * _BLOCK + i],
            )  # fmt: skip
            p = w[(_C + 6) * _BLOCK + i]
            fx, fy, fz, gx, gy, gz, g, own, m = adjoint(c, base, squared, x, y, z, a, b, e, p)
            k, d = kick * h, drift * h
            if varies:
                gather(w, i, k, x, y, z, a, b, e, own, m)
            u, v = w[3 * _BLOCK + i] - k * fx, w[4 * _BLOCK + i] - k * fy
            s = w[5 * _BLOCK + i] - k * fz
            rx, ry = w[_C * _BLOCK + i] + k * gx, w[(_C + 1) * _BLOCK + i] + k * gy
            rz = w[(_C + 2) * _BLOCK + i] + k * gz
            w[_OF_BASE * _BLOCK + i] += k * g
            w[i], w[_BLOCK + i], w[2 * _BLOCK + i] = x - d * u, y - d * v, z - d * s
            w[3 * _BLOCK + i], w[4 * _BLOCK + i], w[5 * _BLOCK + i] = u, v, s
            w[_C * _BLOCK + i], w[(_C + 1) * _BLOCK + i] = rx, ry
            w[(_C + 2) * _BLOCK + i] = rz
            w[(_C + 3) * _BLOCK + i] = a + d * (rx + p * u)
            w[(_C + 4) * _BLOCK + i] = b + d * (ry + p * v)
            w[(_C + 5) * _BLOCK + i] = e + d * (rz + p * s)

    return begin_block, onwards, along, backwards


def carry_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that carries blocks `first` to `end` of rays through all steps."""
    return _carrier(real, False)


def carry_tangent_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that carries tangents of blocks of rays along with them to their ends."""
    return _carrier(real, True)


def _carrier(real: types.Type, tangents: bool) -> Callable[..., None]:
    at = real_at(real)
    begin_block, onwards, along, _ = _stages(real)
    stage_of, moved, address = (along, _C, COTANGENT) if tangents else (onwards, 0, MOTION)
    kicks = tuple(real(kick) for kick in KICKS)
    drifts = tuple(real(drift) for drift in DRIFTS)
    double, zero = real(2.0) * kicks[0], real(0.0)

    def kernel(job_, first, end):  # noqa: ANN001, ANN202
        job = carray(job_, _JOB)
        count, steps, squared = job[RAYS], job[STEPS], job[SQUARED] != 0
        varies = tangents and job[VARIES] != 0
        found = carray(at(job[address]), UNBOUNDED)
        n = carray(at(job[PROFILE]), COEFFICIENTS)
        c = (
            n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8], n[9], n[10], n[11], n[12], n[13],
        )  # fmt: skip
        n = carray(at(job[OF_PROFILE] if varies else job[PROFILE]), COEFFICIENTS)
        dc = (
            n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8], n[9], n[10], n[11], n[12], n[13],
        )  # fmt: skip
        block = at(job[WORK])
        w = carray(block, _WORK)
        for number in range(first, end):
            begin = number * _BLOCK
            begin_block(job_, block, begin, tangents)
            if tangents:
                of_bases = carray(at(job[OF_BASE]), UNBOUNDED)
                for i in range(_BLOCK):
                    ray = min(begin + i, count - 1)
                    w[_OF_BASE * _BLOCK + i] = of_bases[ray * job[BASE_STEP]]
            stage_of(block, c, squared, zero, kicks[0], varies, dc)
            for step in range(steps):
                for stage in range(_STAGES):
                    kick = kicks[stage + 1]
                    if stage == _STAGES - 1 and step < steps - 1:
                        kick = double
                    stage_of(block, c, squared, drifts[stage], kick, varies, dc)
            for row in range(_PARTS):
                for i in range(min(_BLOCK, count - begin)):
                    found[row * count + begin + i] = w[(moved + row) * _BLOCK + i]

    return kernel


def carry_adjoint_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that takes cotangents of blocks of rays back to their beginnings."""
    at = real_at(real)
    begin_block, _, _, backwards = _stages(real)
    kicks = tuple(real(kick) for kick in KICKS)
    drifts = tuple(real(drift) for drift in DRIFTS)
    double, zero = real(2.0) * kicks[0], real(0.0)

    def kernel(job_, first, end):  # noqa: ANN001, ANN202
        job = carray(job_, _JOB)
        count, steps, squared = job[RAYS], job[STEPS], job[SQUARED] != 0
        varies, blocks = job[VARIES] != 0, (count + _BLOCK - 1) // _BLOCK
        cotangent = carray(at(job[COTANGENT]), UNBOUNDED)
        of_profile = carray(at(job[OF_PROFILE]), UNBOUNDED)
        of_bases = carray(at(job[OF_BASE]), UNBOUNDED)
        n = carray(at(job[PROFILE]), COEFFICIENTS)
        c = (
            n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8], n[9], n[10], n[11], n[12], n[13],
        )  # fmt: skip
        block = at(job[WORK])
        w = carray(block, _WORK)
        for number in range(first, end):
            begin = number * _BLOCK
            begin_block(job_, block, begin, True)
            for i in range(_OF_BASE * _BLOCK, _WORK):
                w[i] = zero
            for step in range(steps):
                for stage in range(_STAGES - 1, -1, -1):
                    kick = kicks[stage + 1]
                    if stage == _STAGES - 1 and step > 0:
                        kick = double
                    backwards(block, c, squared, drifts[stage], kick, varies)
            backwards(block, c, squared, zero, kicks[0], varies)
            for i in range(min(_BLOCK, count - begin)):
                of_bases[begin + i] = w[_OF_BASE * _BLOCK + i]
                for row in range(_PARTS):
                    cotangent[row * count + begin + i] = w[(_C + row) * _BLOCK + i]
            if varies:
                for row in range(COEFFICIENTS):
                    total = zero
                    for i in range(_BLOCK):
                        total += w[(_OF_PROFILE + row) * _BLOCK + i]
                    of_profile[row * blocks + number] = total

    return kernel


def carry(
    motion: Tensor, time: Tensor, base: Tensor, profile: Tensor, squared: bool, steps: int
) -> Tensor:
    """Carry rays through a gradient.

    Args:
        motion: (7, N): position, mm, optical direction, path, mm; it is overwritten.
        time: (N,), ∫ds/n, mm.
        base: (N,) or (1,), index of the homogeneous medium.
        profile: (14,), coefficients of r², r⁴, ..., r¹²; z, ..., z⁴; x, x²; y, y².
        squared: whether n² has this profile, and not n.
        steps: one or more.

    Returns:
        `motion`, at its end.
    """
    job, kept = _job(motion, time, base, profile, squared, steps)
    _run(carry_driver, job, motion)
    del kept
    return motion


def carry_tangent(
    motion: Tensor,
    tangent: Tensor,
    time: Tensor,
    base: Tensor,
    of_base: Tensor,
    profile: Tensor,
    of_profile: Tensor,
    squared: bool,
    steps: int,
) -> Tensor:
    """Return the tangents (7, N) of the end from those of the beginning.

    Args:
        motion: (7, N), the beginning.
        tangent: (7, N), of it; it is overwritten.
        time: as of `carry`, and what follows.
        of_base: tangent of the base, of its shape.
        of_profile: tangent of the profile.
    """
    job, kept = _job(motion, time, base, profile, squared, steps)
    of_profile = of_profile.contiguous()
    job[COTANGENT], job[OF_BASE] = tangent.data_ptr(), of_base.data_ptr()
    job[OF_PROFILE], job[VARIES] = of_profile.data_ptr(), bool(of_profile.any())
    _run(carry_tangent_driver, job, motion)
    del kept, of_profile
    return tangent


def carry_adjoint(
    motion: Tensor,
    cotangent: Tensor,
    time: Tensor,
    base: Tensor,
    profile: Tensor,
    squared: bool,
    steps: int,
    varies: bool = False,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the cotangents (7, N) of the beginning, (N,) of the base, and (14,) of the profile,
    from those of the end.

    Args:
        motion: (7, N), the end.
        cotangent: (7, N), of it; it is overwritten.
        time: as of `carry`, and what follows.
        varies: whether those of the profile are wanted; None comes in their place.
    """
    of_base = torch.empty_like(time)
    of_profile = motion.new_empty(COEFFICIENTS, -(-time.numel() // _BLOCK) if varies else 0)
    job, kept = _job(motion, time, base, profile, squared, steps)
    job[COTANGENT], job[OF_BASE] = cotangent.data_ptr(), of_base.data_ptr()
    job[OF_PROFILE], job[VARIES] = of_profile.data_ptr(), varies
    _run(carry_adjoint_driver, job, motion)
    del kept
    return cotangent, of_base, of_profile.sum(1) if varies else None


def _job(
    motion: Tensor, time: Tensor, base: Tensor, profile: Tensor, squared: bool, steps: int
) -> tuple[np.ndarray, Tensor]:
    """Return the job, and what must be kept as long as it runs."""
    profile = profile.contiguous()
    job = np.zeros(_JOB, dtype=np.int64)
    job[: PROFILE + 1] = [part.data_ptr() for part in (motion, time, base, profile)]
    job[RAYS : BASE_STEP + 1] = (time.numel(), steps, squared, int(base.numel() > 1))
    return job, profile


def _run(driver: compiler.Factory, job: np.ndarray, motion: Tensor) -> None:
    function = compiler.compile_driver(driver, REAL[motion.dtype])
    rays = motion.numel() // _PARTS
    threads = thread_count(rays)
    work = motion.new_empty(threads, _WORK)
    jobs = np.tile(job, (threads, 1))
    jobs[:, WORK] = [part.data_ptr() for part in work]
    spread(function, [own.ctypes.data for own in jobs], -(-rays // _BLOCK))
