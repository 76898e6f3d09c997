"""Paraxial numbers of many lenses of one arrangement are found without a loop over lenses.

Numbers are tensors (L,), or `Tangents` with derivatives.  Lengths are in units of the focal length
that is asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from dolens.lens_search.arrangement import STOP, Arrangement
from dolens.optics.paraxial_recurrence import UNIT_RAYS, Number, TwoRays


@dataclass(frozen=True)
class LensNumbers:
    """The numbers of L lenses: tensors (L,), or such with their derivatives.

    Attributes:
        curvatures: S of the refracting surfaces.
        gaps: G between neighbours of the sequence.
        image: from the last of the sequence to the sensor.
        indices: S + 1 of them: in front of the lens and behind each refracting surface.
        coefficients: of each refracting surface, r⁴ first; none of a sphere.
    """

    curvatures: Sequence[Number]
    gaps: Sequence[Number]
    image: Number
    indices: Sequence[Number]
    coefficients: Sequence[Sequence[Number]] = ()


@dataclass(frozen=True)
class Paraxial:
    """Paraxial numbers of L lenses.

    Attributes:
        power: 1/focal length, (L,).
        back_focus: from the last refracting surface to the focus, (L,).
        entrance_pupil: from the first of the sequence to the entrance pupil, (L,).
        marginal: heights on the S refracting surfaces of a ray parallel to the axis at height 1.
        chief: heights there of a ray of slope 1 through the middle of the stop.
        stop_height: height of the first of these rays at the stop.
        petzval: Σ (n' - n)·c/(n·n'), (L,); 0 is a flat field, 1 that of a thin lens with n = 1.
    """

    power: Number
    back_focus: Number
    entrance_pupil: Number
    marginal: Sequence[Number]
    chief: Sequence[Number]
    stop_height: Number
    petzval: Number


def numbers_of(
    arrangement: Arrangement, variables: Sequence[Number], indices: Sequence[Number]
) -> LensNumbers:
    """Return the numbers of lenses by their variables.

    Args:
        arrangement: the order.
        variables: curvatures, gaps, the sensor's distance and the coefficients of aspheres.
        indices: at the reference wavelength, as in `LensNumbers`.
    """
    s, g = arrangement.surfaces, arrangement.gaps
    coefficients = [[variables[n] for n in own] for own in arrangement.coefficient_columns]
    return LensNumbers(variables[:s], variables[s : s + g], variables[s + g], indices, coefficients)


def paraxial(arrangement: Arrangement, lenses: LensNumbers) -> Paraxial:
    """Trace two paraxial rays through L lenses (Welford, ch. 3)."""
    rays = UNIT_RAYS
    at_stop, back = rays, rays
    met: list[TwoRays] = []
    before = 0
    petzval: Number = 0.0
    last = len(arrangement.sequence) - 1
    for place, number in enumerate(arrangement.sequence):
        if number == STOP:
            at_stop = rays
        else:
            met.append(rays)
            index, behind = lenses.indices[before], lenses.indices[number + 1]
            power = lenses.curvatures[number] * (behind - index)
            petzval = petzval + power / (index * behind)
            rays = TwoRays(rays.y, rays.y2, rays.nu - power * rays.y, rays.nu2 - power * rays.y2)
            before, back = number + 1, rays
        if place < last:
            rays = rays.transferred(lenses.gaps[place], lenses.indices[before])
    # Through the middle of the stop: y₁·A + slope·B = 0.
    height = -at_stop.y2 / at_stop.y
    return Paraxial(
        power=-back.nu,
        back_focus=-back.y / back.nu,
        entrance_pupil=-height,
        marginal=[ray.y for ray in met],
        chief=[height * ray.y + ray.y2 for ray in met],
        stop_height=at_stop.y,
        petzval=petzval,
    )
