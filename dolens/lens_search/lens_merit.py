"""The merit of a search's lenses, whether their glasses are given or chosen."""

from dataclasses import replace

from torch import Tensor

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.glass.glass_merit import GlassMerit
from dolens.lens_search.glass.glass_set import chosen_glasses
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.search_rays import search_rays
from dolens.lens_search.specification import Specification


def merit_of(
    arrangement: Arrangement,
    specification: Specification,
    rings: int = 4,
    arms: int = 8,
    free: bool = True,
) -> SearchMerit:
    """Return the merit with rays of that many rings and arms.

    Args:
        arrangement: the order of elements.
        specification: with a choice of glasses, lenses have glasses of their own.
        rings: of the pupil.
        arms: of its half.
        free: whether chosen glasses may vary.

    Raises:
        InputError: no glass is left to choose.
    """
    if specification.glass_choice is None:
        return SearchMerit.of(arrangement, specification, rings, arms)
    glasses = chosen_glasses(specification.glass_choice, tuple(specification.wavelengths))
    rays = search_rays(specification, rings, arms)
    return GlassMerit(arrangement, specification, rays, glasses=glasses, free=free)


def with_glasses_of(
    arrangement: Arrangement, specification: Specification, values: Tensor
) -> Specification:
    """Return the specification with the glasses of one design u, (N,), and nothing to choose."""
    merit = merit_of(arrangement, specification, 1, 1)
    if not isinstance(merit, GlassMerit):
        return specification
    return replace(specification, glasses=merit.materials(values[None]), glass_choice=None)
