"""First-order optics: the paraxial recurrence, focal length, cardinal points and pupils.

Everything is differentiable.

A paraxial ray at a surface is its height y and its reduced slope n·u.  Refraction leaves the height
alone, n'u' = nu - y(n' - n)c; transfer leaves the reduced slope alone, y' = y + (t/n)·nu (Welford,
ch. 3).  Any two rays give all others, so that two are traced at a time.  Everything here is
arithmetic of numbers and tensors alike.  Where light travels towards -z the index is negative.
What adds to a surface's power (n' - n)c, a diffractive phase or an ideal lens, adds to it here.

Light that travels towards -z, behind an odd number of mirrors, has a negative index there and gaps
of negative thickness: then every equation of refraction holds, and a concave mirror of R = -200 mm
has a focal length of +100.  Coordinate breaks count as planes that do nothing: it is the optics of
the lens unfolded along its axis.

What lies at infinity (the foci of an afocal lens, the pupil of a telecentric one) is `inf` and
carries a zero gradient, so that one infinite quantity leaves the gradients of the others alone.
Only a power that is exactly zero counts: a telescope whose power is a rounding error has an EFL of
1e15 mm or so.  A constraint that must cross zero is better put on `power`.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.bent_paraxial import BentGap
from dolens.optics.materials import is_anisotropic
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem

Number = Any  # of Python's, or a tensor


class TwoRays(NamedTuple):
    """Heights y and reduced slopes n·u of two rays at one plane.

    Of the rays of unit height and of unit reduced slope, these are the rows of the matrix
    [[A, B], [C, D]] that acts on (y, n·u).

    Attributes:
        y: height of the first ray.
        y2: height of the second.
        nu: reduced slope of the first ray.
        nu2: reduced slope of the second.
    """

    y: Number
    y2: Number
    nu: Number
    nu2: Number

    def transferred(self, thickness: Number | BentGap, index: Number) -> "TwoRays":
        """The rays behind a gap of a medium, or of a gradient."""
        if isinstance(thickness, BentGap):
            a, b, c, d, _ = thickness
            y, y2, nu, nu2 = self
            return TwoRays(a * y + b * nu, a * y2 + b * nu2, c * y + d * nu, c * y2 + d * nu2)
        gap = thickness / index
        return TwoRays(self.y + gap * self.nu, self.y2 + gap * self.nu2, self.nu, self.nu2)


UNIT_RAYS = TwoRays(1.0, 0.0, 0.0, 1.0)


def through_surfaces(
    rays: TwoRays,
    curvatures: Sequence[Number],
    thicknesses: Sequence[Number | BentGap],
    indices: Sequence[Number],
    powers: Sequence[Number] | None = None,
) -> Iterator[TwoRays]:
    """Trace two rays from just before the first of some surfaces to just behind the last.

    Args:
        rays: before the first surface, mm.
        curvatures: paraxial, of N surfaces, 1/mm.
        thicknesses: of the N - 1 gaps between them, mm; of a gradient, what it does.
        indices: of the N + 1 media around them; of a gradient, at its front.
        powers: of the N surfaces besides that of refraction, 1/mm; None: they have none.

    Yields:
        The rays just behind each surface, at the heights that they have on it.
    """
    y, y2, nu, nu2 = rays
    for i, curvature in enumerate(curvatures):
        before, behind = indices[i], indices[i + 1]
        if i:
            gap = thicknesses[i - 1]
            if isinstance(gap, BentGap):
                y, y2, nu, nu2 = TwoRays(y, y2, nu, nu2).transferred(gap, before)
                before = gap.behind
            else:
                gap = gap / before
                y, y2 = y + gap * nu, y2 + gap * nu2
        power = (behind - before) * curvature
        if powers is not None:
            power = power + powers[i]
        nu, nu2 = nu - power * y, nu2 - power * y2
        yield TwoRays(y, y2, nu, nu2)


def behind_surfaces(
    curvatures: Sequence[Number],
    thicknesses: Sequence[Number | BentGap],
    indices: Sequence[Number],
    powers: Sequence[Number] | None = None,
) -> TwoRays:
    """Trace the unit rays to just behind the last of some surfaces; themselves where there is none.

    Arguments as of `through_surfaces`.
    """
    every = through_surfaces(UNIT_RAYS, curvatures, thicknesses, indices, powers)
    last = deque(every, maxlen=1)
    return last[0] if last else UNIT_RAYS


class Pupil(NamedTuple):
    """A paraxial image of the stop: z from the first vertex and diameter, mm."""

    z: Tensor
    diameter: Tensor


@dataclass(frozen=True)
class FirstOrder:
    """First-order properties at one wavelength, mm; z is measured from the first vertex.

    It counts along the axis with its thicknesses as written: towards -z behind a mirror.

    With the reduced matrix [[A, B], [C, D]] from the first vertex to the last, and n and n' the
    indices of the object's and the sensor's medium, n' being negative behind an odd number of
    mirrors:

    Attributes:
        efl: effective focal length, 1/power; positive if converging.  The rear focal length is
            n'·efl, the front one n·efl.
        bfd: from the last vertex to the rear focus, n'A/power.
        focus: z of the rear focus.
        entrance_pupil: the stop seen from the object.
        exit_pupil: the stop seen from the sensor.
        f_number: efl / entrance pupil diameter.
        image_index: n'.
        power: -C, 1/mm; zero of an afocal lens.
        ffd: from the first vertex to the front focus, -nD/power; negative in front of the lens.
        front_principal: z of the front principal plane, n(1 - D)/power.
        rear_principal: z of the rear principal plane, last vertex + n'(A - 1)/power.
        front_nodal: z of the front nodal point, (n' - nD)/power.
        rear_nodal: z of the rear nodal point, last vertex + (n'A - n)/power.
        image: z of the image of the axial object point; the focus for an object at infinity.
        magnification: image height over object height; 0 for an object at infinity.
        working_f_number: 1/(2n'|u'|) with u' the slope of the paraxial marginal ray behind the
            lens, negative if diverging; the F-number for an object at infinity.
    """

    efl: Tensor
    bfd: Tensor
    focus: Tensor
    entrance_pupil: Pupil
    exit_pupil: Pupil
    f_number: Tensor
    image_index: Tensor
    power: Tensor
    ffd: Tensor
    front_principal: Tensor
    rear_principal: Tensor
    front_nodal: Tensor
    rear_nodal: Tensor
    image: Tensor
    magnification: Tensor
    working_f_number: Tensor


def surface_matrix(
    system: OpticalSystem, wavelength: float | Tensor, first: int, last: int
) -> Tensor:
    """Paraxial matrix acting on (y, n·u) from just before surface `first` to just after `last`.

    Surfaces count from 1; both planes are the vertices; `first` > `last` is the identity.
    """
    return _matrix(_unit_rays_behind(system, wavelength, first, last), system)


def _unit_rays_behind(
    system: OpticalSystem, wavelength: float | Tensor, first: int, last: int
) -> TwoRays:
    """Trace the unit rays from just before surface `first` to just after `last`."""
    return behind_surfaces(
        curvatures_of(system, first, last),
        system.paraxial_gaps(wavelength)[first - 1 : max(last - 1, 0)],
        system.signed_indices(wavelength)[first - 1 : last + 1],
        powers_of(system, wavelength, first, last),
    )


def matrix_to_stop(system: OpticalSystem, wavelength: float | Tensor) -> Tensor:
    """Paraxial matrix on (y, n·u) from just before the first vertex to just before the stop."""
    stop = system.stop
    # The stop's own refraction belongs to the light behind it.
    rays = _unit_rays_behind(system, wavelength, 1, stop - 1)
    if stop > 1:
        index = system.signed_indices(wavelength)[stop - 1]
        rays = rays.transferred(system.paraxial_gaps(wavelength)[stop - 2], index)
    return _matrix(rays, system)


def ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """numerator / denominator; `inf`, with zero gradient, where the denominator is zero."""
    zero = denominator == 0.0
    quotient = numerator / torch.where(zero, torch.ones_like(denominator), denominator)
    return torch.where(zero, torch.full_like(quotient, math.inf), quotient)


def vergence(object_distance: float | Tensor | None) -> float | Tensor:
    """One over the object's distance in front of the first vertex, 1/mm; 0 for None or infinity.

    Raises:
        InputError: the distance is a number that is not positive.
    """
    if object_distance is None:
        return 0.0
    if not isinstance(object_distance, Tensor) and not object_distance > 0.0:
        raise InputError(
            f"object_distance must be positive (mm in front of the first vertex), or None for an "
            f"object at infinity, not {object_distance}"
        )
    return 1.0 / object_distance


def entrance_pupil(system: OpticalSystem, wavelength: float | Tensor) -> Pupil:
    """Image of the stop through the surfaces before it."""
    matrix = matrix_to_stop(system, wavelength)
    # A ray with y = 0 on the stop crosses the axis where the object space sees the stop.
    a, b = matrix[0, 0], matrix[0, 1]
    diameter = 2.0 * system.surfaces[system.stop - 1].semi_diameter
    return Pupil(ratio(b * system.signed_indices(wavelength)[0], a), _over(diameter, a.abs()))


def exit_pupil(system: OpticalSystem, wavelength: float | Tensor) -> Pupil:
    """Image of the stop through the surfaces from the stop on."""
    stop, count = system.stop, len(system.surfaces)
    matrix = surface_matrix(system, wavelength, stop, count)
    b, d = matrix[0, 1], matrix[1, 1]
    n = system.signed_indices(wavelength)[-1]
    # From the axis at the stop: height b and slope d/n at the last vertex, per unit of n·u.
    diameter = 2.0 * system.surfaces[stop - 1].semi_diameter
    return Pupil(system.vertices[count - 1] + ratio(-b * n, d), _over(diameter, d.abs()))


def first_order(
    system: OpticalSystem,
    wavelength: float | Tensor,
    object_distance: float | Tensor | None = None,
) -> FirstOrder:
    """First-order properties of a centred lens.

    Args:
        system: the lens.
        wavelength: nm.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
    """
    count = len(system.surfaces)
    matrix = surface_matrix(system, wavelength, 1, count)
    (a, b), (c, d) = matrix[0].unbind(), matrix[1].unbind()
    indices = system.signed_indices(wavelength)
    before, behind = indices[0], indices[-1]
    power = -c
    last = system.vertices[count - 1]
    bfd = ratio(behind * a, power)
    to_stop = matrix_to_stop(system, wavelength)
    near = before * vergence(object_distance)
    # Per unit of height at the first vertex, the axial ray's height at the stop and n'u' behind.
    at_stop, leaving = to_stop[0, 0] + to_stop[0, 1] * near, c + d * near
    radius = system.surfaces[system.stop - 1].semi_diameter
    return FirstOrder(
        efl=_over(1.0, power),
        bfd=bfd,
        focus=last + bfd,
        entrance_pupil=entrance_pupil(system, wavelength),
        exit_pupil=exit_pupil(system, wavelength),
        f_number=ratio(to_stop[0, 0].abs(), 2.0 * radius * power),
        image_index=torch.as_tensor(behind, dtype=system.dtype, device=system.device),
        power=power,
        ffd=ratio(-before * d, power),
        front_principal=ratio(before * (1.0 - d), power),
        rear_principal=last + ratio(behind * (a - 1.0), power),
        front_nodal=ratio(behind - before * d, power),
        rear_nodal=last + ratio(behind * a - before, power),
        image=last + ratio(-behind * (a + b * near), leaving),
        magnification=ratio(near * torch.ones_like(leaving), leaving),
        working_f_number=ratio(at_stop.abs(), -2.0 * radius * leaving),
    )


def chief_ray_magnification(
    system: OpticalSystem, wavelength: float | Tensor, depth: float
) -> Tensor:
    """Height on the sensor over height on the object, along the paraxial chief ray.

    The chief ray passes the centre of the stop, so the ratio stays meaningful where the sensor
    is out of focus: it is where the blur is centred.  Negative for an inverted image.

    Args:
        system: the lens.
        wavelength: nm.
        depth: distance of the object in front of the first vertex, mm.
    """
    pupil = entrance_pupil(system, wavelength)
    indices = system.signed_indices(wavelength)
    # Object height 1: the chief ray heads from (z = -depth, y = 1) to the entrance pupil's centre.
    slope = -1.0 / (pupil.z + depth)
    height = 1.0 + slope * depth
    matrix = surface_matrix(system, wavelength, 1, len(system.surfaces))
    y = matrix[0, 0] * height + matrix[0, 1] * (indices[0] * slope)
    u = (matrix[1, 0] * height + matrix[1, 1] * (indices[0] * slope)) / indices[-1]
    return y + u * system.sensor_distance


def _over(numerator: float, denominator: Tensor) -> Tensor:
    return ratio(torch.full_like(denominator, numerator), denominator)


def _matrix(rays: TwoRays, like: OpticalSystem) -> Tensor:
    """The 2×2 matrix that takes the unit rays to these."""
    entries = [torch.as_tensor(e, dtype=like.dtype, device=like.device) for e in rays]
    return torch.stack(entries).reshape(2, 2)


def curvatures_of(
    system: OpticalSystem, first: int = 1, last: int | None = None
) -> list[Tensor | float]:
    """Return the paraxial curvatures (1/mm) of surfaces `first` to `last`, from 1: the means over
    azimuth, or those along the system's meridian.
    """
    return [
        s.shape.paraxial_curvature(s.parameters)
        if system.meridian is None or s.shape.rotational
        else s.shape.section_curvature(s.parameters, *_direction(system, number))
        for number, s in _numbered(system, first, last)
    ]


def powers_of(
    system: OpticalSystem, wavelength: float | Tensor, first: int = 1, last: int | None = None
) -> list[Tensor | float] | None:
    """Return the powers (1/mm) that phases, ideal lenses and crystals add to surfaces `first` to
    `last`.

    Extraordinary rays see another index at the face of their crystal than in it, see
    `Uniaxial.axial_index`: its difference times the curvature is added here.

    Args:
        system: the lens.
        wavelength: nm.
        first: number of the first surface, from 1.
        last: number of the last; None: of the lens.

    Returns:
        One power a surface, or None where none adds any: the mean over azimuth, or that along the
        system's meridian.
    """
    media = system.materials[first - 1 : None if last is None else last + 1]
    crystals = any(map(is_anisotropic, media))
    if not (crystals or deflects(system.surfaces[first - 1 : last])):
        return None
    found: list[Tensor | float] = []
    for number, surface in _numbered(system, first, last):
        own = surface.deflection
        if own is None:
            found.append(0.0)
        elif system.meridian is None or own.law.rotational:
            found.append(own.law.paraxial_power(own.parameters).at(wavelength))
        else:
            way = _direction(system, number)
            found.append(own.law.section_power(own.parameters, *way).at(wavelength))
    if crystals:
        indices, senses = system.indices(wavelength), system.senses
        shifts = [
            sense * (medium.axial_index(wavelength) - index) if is_anisotropic(medium) else 0.0
            for medium, index, sense in zip(system.materials, indices, senses, strict=True)
        ]
        for place, curvature in enumerate(curvatures_of(system, first, last)):
            step = shifts[first + place] - shifts[first + place - 1]
            found[place] = found[place] + step * curvature
    return found


def _numbered(
    system: OpticalSystem, first: int, last: int | None
) -> list[tuple[int, SurfaceState]]:
    return list(enumerate(system.surfaces, 1))[first - 1 : last]


def _direction(system: OpticalSystem, number: int) -> tuple[Number, Number]:
    """Return the direction (x, y) of the system's meridian in a surface's own axes, of length one.

    Turns about z turn it; of other tilts, as of a fold, the lens is unfolded along its axis.
    """
    along_x = system.meridian == "x"
    rotation = system.axes[number - 1].rotation
    if rotation is None:
        return (1.0, 0.0) if along_x else (0.0, 1.0)
    # Of the lens's x and y the one that lies more across the surface's axis tells the turn.
    x, y = rotation[0, :2], rotation[1, :2]
    if float(x.norm()) >= float(y.norm()):
        cosine, sine = (x / x.norm()).unbind()
    else:
        cosine, sine = (y / y.norm()).flip(0).unbind()
        sine = -sine
    return (cosine, sine) if along_x else (-sine, cosine)


def deflects(surfaces: Sequence[SurfaceState]) -> bool:
    """Return whether any of the surfaces deflects light by a law of its own."""
    return any(s.deflection is not None for s in surfaces)
