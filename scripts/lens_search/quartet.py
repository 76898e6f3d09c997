"""The monochromatic quartet as a plain problem: variables, bounds, limits and merit.

Four lenses of n = 1.5168, EFL 100 mm, f/3, half fields 0, 10.5 and 15°, an infinitely far object.
The 17 variables of a candidate, a row of an array, are 8 curvatures (1/mm), the 7 gaps between the
vertices (mm; glass, air, glass, …), the image distance from the last vertex and the distance of the
entrance pupil from the first (mm).  Nothing is vignetted.  The stop is free: it may lie where no
diaphragm can be put, inside a thick lens.  With `air_stop` it must lie in air.
"""

from dataclasses import dataclass

import numpy as np

from lens_search.plain_trace import (
    Array,
    PupilRays,
    Traced,
    first_order,
    pupil_rays,
    rms_um,
    trace,
)

INDEX = 1.5168
INDICES = np.array([INDEX, 1.0] * 4)
FOCAL_LENGTH = 100.0
F_NUMBER = 3.0
ANGLES = np.array([0.0, 10.5, 15.0])
DISTORTION = 0.01
BACK_FOCUS = 30.0
LENGTH = 250.0
GLASS = (2.0, 120.0)
AIR = 0.1
# Mean RMS spots up to here are counted as designs of a form of their own, µm.
GOOD = 8.5
# A focal length off by so much is met, mm: a merit scales with it, so that it gains 0.1 %.
FOCAL_TOLERANCE = 0.1
# Curvatures to R = 20 mm: a beam of 33 mm has to pass.
LOWER = np.array([-0.05] * 8 + [GLASS[0], AIR] * 3 + [GLASS[0], BACK_FOCUS, -100.0])
UPPER = np.array([0.05] * 8 + [GLASS[1], 120.0] * 3 + [GLASS[1], 200.0, 200.0])
SAMPLE = pupil_rays(4, 8)
DENSE = pupil_rays(24, 48, rim=49)
LIMITS = (
    "focal length",
    *(f"distortion at {angle:g}°" for angle in ANGLES[1:]),
    "back focus",
    "length",
    *(f"thinnest {'glass' if k % 2 == 0 else 'air'} {k // 2 + 1}" for k in range(7)),
    *(f"thickest glass {k + 1}" for k in range(4)),
    *(f"edge of gap {k + 1}" for k in range(7)),
    "rays that fail",
    "stop in glass",
)
_SLACK = np.array([1e-4 if "distortion" in limit else 0.03 for limit in LIMITS])
# Units in which broken limits are alike.
UNITS = _SLACK.copy()
_SLACK[LIMITS.index("rays that fail")] = 0.0


@dataclass(frozen=True)
class Measured:
    """What candidates are.

    Attributes:
        rms: (lenses, fields) RMS spot radii, µm.
        excess: (lenses, limits) by how much each of `LIMITS` is broken, in its own unit (mm; 1 for
            distortion; squared cosines for rays): 0 where it is kept.
        focal_length: (lenses,), mm.
        distortion: (lenses, 2) relative, at 10.5° and 15°.
        edge: (lenses, 7) gaps where the beam ends on the smaller of both surfaces, mm.
        outer_edge: (lenses, 7) the same where it ends on the larger; NaN where one ends before.
        depth: (lenses,) of the paraxial stop in glass, mm; 0 in air.
    """

    rms: Array
    excess: Array
    focal_length: Array
    distortion: Array
    edge: Array
    outer_edge: Array
    depth: Array

    @property
    def mean(self) -> Array:
        """The merit: the mean of the three RMS radii, µm."""
        return self.rms.mean(axis=1)

    @property
    def feasible(self) -> np.ndarray:
        """Whether a candidate keeps all limits."""
        return self.excess.max(axis=1) <= 1e-9

    @property
    def nearly(self) -> np.ndarray:
        """Whether it keeps them to 0.03 mm, and distortion to 1e-4."""
        return (self.excess <= _SLACK).all(axis=1)

    @property
    def broken(self) -> list[str]:
        """What the first candidate breaks by more than that, in words."""
        found = zip(LIMITS, self.excess[0], _SLACK, strict=True)
        return [f"{name} by {value:.3g}" for name, value, slack in found if value > slack]


def split(candidates: Array) -> tuple[Array, Array, Array, Array]:
    """Return curvatures, gaps, image distances and pupil distances."""
    return candidates[:, :8], candidates[:, 8:15], candidates[:, 15], candidates[:, 16]


def measure(candidates: Array, rays: PupilRays = SAMPLE, air_stop: bool = False) -> Measured:
    """Measure candidates.

    Args:
        candidates: (lenses, 17).
        rays: of each beam.
        air_stop: whether a stop in glass breaks a limit.
    """
    return judged(candidates, *_beams(candidates, rays, 1.0, 1.0), rays, air_stop)


def judged(
    candidates: Array, traced: Traced, distortion: Array, rays: PupilRays, air_stop: bool = False
) -> Measured:
    """Return what candidates are, from their beams.

    Args:
        candidates: (lenses, 17).
        traced: the beams.
        distortion: (lenses, 2) of their chief rays.
        rays: of each beam.
        air_stop: whether a stop in glass breaks a limit.
    """
    depth = stop_depth(candidates)
    curvature, gap, image, _ = split(candidates)
    focal, _ = first_order(curvature, gap, INDICES)
    inner = np.minimum(traced.height[:, :-1], traced.height[:, 1:])
    outer = np.maximum(traced.height[:, :-1], traced.height[:, 1:])
    edge = gap_at(curvature, gap, inner)
    crossing = np.maximum(-edge, np.maximum(-traced.shortest, 0.0))
    lens, air = gap[:, ::2], gap[:, 1::2]
    thinnest = np.empty_like(gap)
    thinnest[:, ::2], thinnest[:, 1::2] = GLASS[0] - lens, AIR - air
    excess = np.column_stack(
        [
            np.abs(focal - FOCAL_LENGTH) - FOCAL_TOLERANCE,
            np.abs(distortion) - DISTORTION,
            BACK_FOCUS - image,
            gap.sum(axis=1) + image - LENGTH,
            thinnest,
            lens - GLASS[1],
            np.nan_to_num(crossing, nan=1.0),
            traced.lacking,
            depth * air_stop,
        ]
    )
    return Measured(
        rms_um(traced, rays),
        np.maximum(excess, 0.0),
        focal,
        distortion,
        edge,
        gap_at(curvature, gap, outer),
        depth,
    )


def _beams(
    candidates: Array, rays: PupilRays, part: float, aperture: float
) -> tuple[Traced, Array]:
    """Return traced beams and the relative distortion of the fields off axis."""
    curvature, gap, image, pupil = split(candidates)
    angles = part * ANGLES
    diameter = aperture * FOCAL_LENGTH / F_NUMBER
    traced = trace(curvature, gap, INDICES, image, pupil, diameter, angles, rays)
    return traced, distortion_of(traced, rays, angles)


def distortion_of(traced: Traced, rays: PupilRays, angles: Array = ANGLES) -> Array:
    """Return the relative distortion of the fields off axis."""
    ideal = FOCAL_LENGTH * np.tan(np.radians(angles[1:]))
    return traced.y[:, 1:, rays.chief] / ideal - 1.0


def residuals(
    candidates: Array,
    rays: PupilRays = SAMPLE,
    part: float = 1.0,
    aperture: float = 1.0,
    stiffness: float = 1.0,
) -> Array:
    """Return rows whose sum of squares a least-squares solver makes small: (lenses, residuals).

    The first are transverse aberrations, µm, whose sum of squares is the sum of the squared RMS
    radii; then the limits, with a stiffness of 1: 1 µm for 20 µm of focal length, for 1e-4 of
    distortion beyond 0.99 %, for 50 µm of a gap, and of an edge below 5 µm.
    """
    curvature, gap, image, _ = split(candidates)
    traced, distortion = _beams(candidates, rays, part, aperture)
    root = 1e3 * np.sqrt(rays.weight[rays.weight > 0.0])
    mean = (traced.y * rays.weight).sum(axis=2, keepdims=True)
    inside = rays.weight > 0.0
    across = (traced.x[:, :, inside] * root).reshape(len(candidates), -1)
    along = ((traced.y - mean)[:, :, inside] * root).reshape(len(candidates), -1)
    focal, _ = first_order(curvature, gap, INDICES)
    inner = np.minimum(traced.height[:, :-1], traced.height[:, 1:])
    edge = np.nan_to_num(gap_at(curvature, gap, inner), nan=-1.0)
    glass, air = gap[:, ::2], gap[:, 1::2]
    hinge = np.column_stack(
        [
            1e4 * (np.abs(distortion) - 0.99 * DISTORTION),
            20.0 * (gap.sum(axis=1) + image - LENGTH),
            20.0 * (BACK_FOCUS - image),
            20.0 * (GLASS[0] - glass),
            20.0 * (glass - GLASS[1]),
            20.0 * (AIR - air),
            20.0 * (0.005 - edge),
            1e3 * traced.lacking,
        ]
    )
    apart = stiffness * 50.0 * (np.clip(focal, -1e4, 1e4) - FOCAL_LENGTH)
    return np.column_stack([across, along, apart, stiffness * np.maximum(hinge, 0.0)])


def stop_depth(candidates: Array) -> Array:
    """Return how deep in glass the stop's place is, up to 5 mm: 0 in air, or in front of the lens.

    The stop may lie wherever the paraxial chief ray crosses the axis; a pupil whose ray crosses it
    nowhere from the first vertex to the image has none, and counts as 5 mm deep.
    """
    curvature, gap, image, pupil = split(candidates)
    ahead = np.column_stack([gap, image])
    depth = np.where(pupil <= 0.0, 0.0, 5.0)
    y, u, before = -pupil, np.ones(len(candidates)), 1.0
    for k, index in enumerate(INDICES):
        u = (before * u - y * curvature[:, k] * (index - before)) / index
        before = index
        further = y + ahead[:, k] * u
        place = -y / np.where(u == 0.0, 1e-300, u)
        inside = np.minimum(place, ahead[:, k] - place) if index > 1.0 else 0.0
        depth = np.where(y * further <= 0.0, np.minimum(depth, np.maximum(inside, 0.0)), depth)
        y = further
    return depth


def gap_at(curvature: Array, gap: Array, height: Array) -> Array:
    """Return gaps between neighbouring spheres at heights from the axis; NaN beyond a sphere."""

    def sag(c: Array) -> Array:
        inside = 1.0 - (c * height) ** 2
        root = np.sqrt(np.where(inside > 0.0, inside, np.nan))
        return c * height**2 / (1.0 + root)

    return gap - sag(curvature[:, :-1]) + sag(curvature[:, 1:])


def apart(one: Array, other: Array) -> bool:
    """Return whether two designs are of different forms.

    They are where a curvature differs by more than 0.002/mm (0.25 mm of sag at the pupil's edge)
    or a gap by more than 5 mm.
    """
    difference = np.abs(one - other)
    return bool(difference[:8].max() > 0.002 or difference[8:15].max() > 5.0)


def forms(designs: Array, merit: Array) -> list[int]:
    """Return the places of the best design of every form, best first."""
    kept: list[int] = []
    for place in np.argsort(merit):
        if all(apart(designs[place], designs[k]) for k in kept):
            kept.append(int(place))
    return kept
