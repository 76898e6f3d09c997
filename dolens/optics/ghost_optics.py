"""Ghost paths by first-order optics: foci, pupils, and the light that is left at normal incidence.

All numbers come without a trace, so that thousands of paths take some milliseconds.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.optics.ghost_paths import Path, ghost_path_systems, unfolded, with_losses
from dolens.optics.paraxial import behind_surfaces, curvatures_of, first_order, powers_of, vergence
from dolens.optics.system import OpticalSystem

# First zero of Bessel's J₁ over 2π.
_AIRY = 0.6098349456332723


class GhostFirstOrder(NamedTuple):
    """First-order optics of P unfolded paths, each number (P,), mm; infinite where there is none.

    Attributes:
        focus: from the sensor to where an axial beam is focused; negative in front of it.
        efl: effective focal length of the path.
        marginal: height at the sensor of the marginal ray of the lens's axial beam.
        pupil: from the sensor to the image of the stop, as its first pass is seen from behind.
        slope: of the marginal ray at the sensor.
    """

    focus: Tensor
    efl: Tensor
    marginal: Tensor
    pupil: Tensor
    slope: Tensor

    def diffraction(self, wavelength: float) -> Tensor:
        """Return the radius (mm) by which diffraction at the image of the stop spreads the light,
        to the first zero: Airy's where the sensor is in the focus.

        Args:
            wavelength: nm.
        """
        # Of the pupil's rim as seen from the sensor; of the beam, where the pupil is at infinity.
        tangent = self.marginal / self.pupil + self.slope
        return _AIRY * wavelength * 1e-6 / tangent.abs()


def ghosts_first_order(
    system: OpticalSystem,
    paths: Sequence[Path],
    wavelength: float,
    object_distance: float | None = None,
) -> GhostFirstOrder:
    """Return first-order optics of unfolded paths, without gradients.

    Numbers of Python's take a hundredth of the time that `first_order` of a path's system takes,
    which gives the same with gradients.

    Args:
        system: the lens.
        paths: as `ghost_paths` gives them.
        wavelength: nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """
    curvatures, gaps, indices = (
        [float(value) for value in values]
        for values in (
            [*curvatures_of(system), 0.0 if system.image is None else _curvature(system)],
            [*system.thicknesses, system.sensor_distance],
            system.indices(wavelength),
        )
    )
    powers = powers_of(system, wavelength)
    added = [0.0] * len(curvatures) if powers is None else [*map(float, powers), 0.0]
    first = first_order(system, wavelength, object_distance)
    near = indices[0] * float(vergence(object_distance))
    pupil = first.entrance_pupil
    height = 0.5 * float(pupil.diameter)
    if near:
        # From the axial object point to the rim of the pupil.
        height /= 1.0 + float(pupil.z) * float(vergence(object_distance))
    rows = []
    negative = [-gap for gap in gaps]
    for path, ghost in zip(paths, ghost_path_systems(system, paths), strict=True):
        way = unfolded(path, len(system.surfaces))
        n = [s * indices[medium] for s, medium in zip(ghost.senses, way.media, strict=True)]
        c = [curvatures[number - 1] for number in way.numbers]
        t = way.between(gaps, negative)
        # A surface that reflects does not deflect by its law.
        p = [0.0 if i in way.bounces else added[m - 1] for i, m in enumerate(way.numbers)]
        a, b, low, d = behind_surfaces(c, t, n, p)
        behind, distance = n[-1], gaps[-1]
        y, nu = height * (a + b * near), height * (low + d * near)
        stop = ghost.stop - 1
        _, b_stop, _, d_stop = behind_surfaces(c[stop:], t[stop:], n[stop:], p[stop:])
        rows.append(
            (
                math.inf if nu == 0.0 else -behind * y / nu - distance,
                math.inf if low == 0.0 else -1.0 / low,
                y + nu / behind * distance,
                math.inf if d_stop == 0.0 else -behind * b_stop / d_stop - distance,
                nu / behind,
            )
        )
    found = torch.tensor(rows, dtype=torch.float64)
    return GhostFirstOrder(*found.unbind(-1))


def _curvature(system: OpticalSystem) -> Any:
    assert system.image is not None  # the caller looked
    return system.image.parameters["curvature"]


class NormalIncidence:
    """Gives the share of light that is left along a path, by coatings at normal incidence.

    Surfaces without a coating are bare glass; what glass absorbs does not count.

    Args:
        system: the lens.
        wavelength: nm.
        sensor_reflectance: share that the sensor reflects.
    """

    def __init__(
        self, system: OpticalSystem, wavelength: float, sensor_reflectance: float = 0.0
    ) -> None:
        indices, along = system.indices(wavelength), torch.ones((), dtype=torch.float64)
        one, zero = along, 0.0 * along
        self.count = len(system.surfaces)
        # By number: passed, and reflected of light that comes onwards, and on the way back.
        self.passed: dict[int, Tensor] = {}
        self.reflected: dict[tuple[int, bool], Tensor] = {}
        for number, surface in enumerate(with_losses(system).surfaces, 1):
            front, behind = indices[number - 1], indices[number]
            coating = surface.coating
            if coating is None:
                self.passed[number] = one
                continue
            onward = coating.shares(front, behind, along, wavelength)
            if number in system.mirrors:
                self.passed[number] = onward.reflected
                continue
            back = coating.turned_round().shares(behind, front, along, wavelength)
            self.passed[number] = onward.passed
            self.reflected[number, True] = onward.reflected
            self.reflected[number, False] = back.reflected
        self.reflected[self.count + 1, True] = zero + sensor_reflectance

    def share(self, path: Path) -> Tensor:
        """Return the share of a path, a scalar; () is that of the image."""
        way = unfolded(path, self.count)
        found = torch.ones((), dtype=torch.float64)
        for place, (number, onward) in enumerate(zip(way.numbers, way.onwards, strict=True)):
            bounces = place in way.bounces
            found = found * (self.reflected[number, onward] if bounces else self.passed[number])
        return found
