"""Real and paraxial rays through many lenses of spheres at once, in NumPy and float64.

It is written from the definitions alone and imports nothing of dolens.  A lens is a row: curvatures
(1/mm), gaps between vertices (mm), indices behind the surfaces; axes are those of dolens.  A ray
that misses a surface or is totally reflected goes on along a made-up path, so that an optimizer has
numbers everywhere; how much its cosines lack is added up and says that it failed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Squared cosines below this are those of rays that fail.
_LEAST = 1e-6
# Rays steeper than this fail: their cosine with the axis.
_STEEP = 0.05


@dataclass(frozen=True)
class PupilRays:
    """Rays of one beam over half of a pupil of radius 1; the lens mirrors them in x.

    Attributes:
        x: (rays,).
        y: (rays,).
        weight: (rays,) of the pupil's area, 1 in all; 0 for the chief ray and those of the rim.
        rim: (rays,) whether it is one of the rim.
    """

    x: Array
    y: Array
    weight: Array
    rim: NDArray[np.bool_]

    @property
    def chief(self) -> int:
        """The place of the chief ray."""
        return 0


def pupil_rays(rings: int, arms: int, rim: int = 2) -> PupilRays:
    """Return the rays of a quadrature that is exact for polynomials over the disk.

    Args:
        rings: Gauss's nodes in the squared radius.
        arms: half azimuths from the y axis, at the middles of equal sectors of the half disk.
        rim: azimuths of the rim from +y to -y, both included: they weigh nothing.
    """
    node, share = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt((node + 1.0) / 2.0)
    angle = np.pi * (np.arange(arms) + 0.5) / arms
    edge = np.pi * np.arange(rim) / max(rim - 1, 1)
    x = np.outer(radius, np.sin(angle)).ravel()
    y = np.outer(radius, np.cos(angle)).ravel()
    weight = np.outer(share / 2.0, np.full(arms, 1.0 / arms)).ravel()
    return PupilRays(
        np.concatenate([[0.0], np.sin(edge), x]),
        np.concatenate([[0.0], np.cos(edge), y]),
        np.concatenate([np.zeros(1 + rim), weight]),
        np.concatenate([[False], np.full(rim, True), np.full(x.size, False)]),
    )


@dataclass(frozen=True)
class Traced:
    """What became of the rays.

    Attributes:
        x: (lenses, fields, rays) where they meet the image plane, mm.
        y: likewise.
        height: (lenses, surfaces) of the farthest ray from the axis, mm.
        shortest: (lenses, surfaces - 1) least path from a surface to the next, mm.
        lacking: (lenses,) what squared cosines lacked; 0 where all rays pass.
    """

    x: Array
    y: Array
    height: Array
    shortest: Array
    lacking: Array


def trace(
    curvature: Array,
    gap: Array,
    index: Array,
    image: Array,
    pupil: Array,
    diameter: float,
    angles: Array,
    rays: PupilRays,
) -> Traced:
    """Trace beams of an infinitely far object to the image plane.

    Args:
        curvature: (lenses, surfaces), 1/mm.
        gap: (lenses, surfaces - 1), mm.
        index: (surfaces,) behind each surface; 1 in front of the first.
        image: (lenses,) from the last vertex, mm.
        pupil: (lenses,) of the entrance pupil from the first vertex, mm.
        diameter: of the entrance pupil, mm.
        angles: (fields,), degrees.
        rays: of each field.
    """
    lenses, surfaces = curvature.shape
    shape = (lenses, angles.size * rays.x.size)
    slope = np.radians(np.repeat(angles, rays.x.size))
    x = np.tile(rays.x * diameter / 2.0, angles.size) + np.zeros((lenses, 1))
    y = np.tile(rays.y * diameter / 2.0, angles.size) + np.zeros((lenses, 1))
    z = pupil[:, None] + np.zeros(shape)
    dx, dy, dz = np.zeros(shape), np.sin(slope) + np.zeros(shape), np.cos(slope) + np.zeros(shape)
    lacking = np.zeros(lenses)
    height, shortest = np.empty((lenses, surfaces)), np.empty((lenses, surfaces - 1))
    before = 1.0
    for k in range(surfaces):
        c = curvature[:, k, None]
        along = dz - c * (x * dx + y * dy + z * dz)
        across = c * (x * x + y * y + z * z) - 2.0 * z
        squared = along * along - c * across
        cosine = np.sqrt(np.maximum(squared, _LEAST))
        ratio = before / index[k]
        bent = 1.0 - ratio * ratio * (1.0 - squared)
        passes = (squared > _LEAST) & (along + cosine > _LEAST) & (bent > _LEAST)
        if not passes.all():
            lacking += _lack(squared) + _lack(along + cosine) + _lack(bent)
            # A ray that fails goes straight on from the vertex plane.
            c = np.where(passes, c, 0.0)
            along = np.where(passes, along, np.maximum(dz, _STEEP))
            across = np.where(passes, across, -2.0 * z)
            cosine = np.where(passes, cosine, along)
        # The root that runs into the vertex plane's as c goes to 0.
        far = across / (along + cosine)
        x, y, z = x + far * dx, y + far * dy, z + far * dz
        height[:, k] = np.sqrt(np.max(x * x + y * y, axis=1))
        if k:
            shortest[:, k - 1] = far.min(axis=1)
        turn = np.sqrt(np.maximum(bent, _LEAST)) - ratio * cosine
        upright = 1.0 - c * z
        if not passes.all():
            ratio = np.where(passes, ratio, 1.0)
            turn = np.where(passes, turn, 0.0)
        dx, dy = ratio * dx - turn * c * x, ratio * dy - turn * c * y
        dz = ratio * dz + turn * upright
        forward = (upright > 0.0) & (dz > _STEEP)
        if not forward.all():
            lacking += _lack(upright) + _lack(dz, _STEEP)
            dx, dy = np.where(forward, dx, 0.0), np.where(forward, dy, 0.0)
            dz = np.where(forward, dz, 1.0)
        before = index[k]
        if k < surfaces - 1:
            z = z - gap[:, k, None]
    far = (image[:, None] - z) / dz
    beams = (lenses, angles.size, rays.x.size)
    return Traced(
        (x + far * dx).reshape(beams), (y + far * dy).reshape(beams), height, shortest, lacking
    )


def _lack(value: Array, least: float = _LEAST) -> Array:
    return np.maximum(least - value, 0.0).sum(axis=1)


def rms_um(traced: Traced, rays: PupilRays) -> Array:
    """Return the RMS radius of each spot about its centroid, (lenses, fields), µm.

    The half pupil's mirror image has the same y and the other x, so the centroid lies on x = 0.
    """
    mean = (traced.y * rays.weight).sum(axis=2, keepdims=True)
    square = traced.x**2 + (traced.y - mean) ** 2
    return 1e3 * np.sqrt((square * rays.weight).sum(axis=2))


def first_order(curvature: Array, gap: Array, index: Array) -> tuple[Array, Array]:
    """Return focal length and paraxial back focus of each lens, mm."""
    y, u = np.ones(len(curvature)), np.zeros(len(curvature))
    before = 1.0
    for k in range(curvature.shape[1]):
        u = (before * u - y * curvature[:, k] * (index[k] - before)) / index[k]
        before = index[k]
        if k < gap.shape[1]:
            y = y + gap[:, k] * u
    slope = -np.where(u == 0.0, 1e-300, u)
    return 1.0 / slope, y / slope
