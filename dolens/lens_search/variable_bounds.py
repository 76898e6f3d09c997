"""The box that the variables of a search stay in."""

import torch
from torch import Tensor

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.specification import Specification

# Of one term of an asphere, over the focal length.
_MOST_BEND = 2.0


def variable_bounds(
    arrangement: Arrangement, specification: Specification
) -> tuple[Tensor, Tensor]:
    """Return the least and greatest of the variables u, (P,) each.

    Args:
        arrangement: the order of elements.
        specification: its limits of thicknesses and of the back focus hold; an unlimited air space
            ends at twice the focal length.
    """
    f, limits = specification.focal_length, specification.limits
    lower, upper = [-20.0] * arrangement.surfaces, [20.0] * arrangement.surfaces
    place_of_stop = arrangement.stop_place
    for gap, medium in enumerate(arrangement.gap_media):
        low, high = limits.glass if medium >= 0 else limits.air
        if gap in (place_of_stop - 1, place_of_stop):
            # Two gaps about the stop make one space; the stop may touch a lens.
            low = 0.5 * low
        lower.append(low / f)
        upper.append(2.0 if high is None else high / f)
    lower.append(limits.back_focus / f)
    upper.append(3.0)
    # A single term bends the edge of the axial beam at the entrance pupil by so much at most.
    axial = 0.5 / specification.f_number
    powers = arrangement.powers[arrangement.image_column + 1 :]
    widest = [_MOST_BEND / axial ** (1 - power) for power in powers]
    lower += [-most for most in widest]
    upper += widest
    return (
        torch.tensor(lower, dtype=torch.float64),
        torch.tensor(upper, dtype=torch.float64),
    )
