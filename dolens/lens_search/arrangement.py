"""An arrangement is the order of elements, air spaces and the stop, without numbers; its variables
have names and bounds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dolens.lens_search.specification import Specification
from dolens.optics.lens import Lens
from dolens.prescriptions.build import lens_from_prescription

AIR = -1
STOP = -1


@dataclass(frozen=True)
class Arrangement:
    """The order of elements and of the stop.

    The lens's sequence is that of its refracting surfaces with the stop among them.  Gaps lie
    between neighbours of the sequence.

    Attributes:
        groups: elements of each cemented group.
        stop: behind how many groups the stop stands.
        within: behind how many surfaces of the next group it stands, in glass; 0: in air.
        terms: aspheric coefficients of each refracting surface, r⁴ first; (): spheres.
    """

    groups: tuple[int, ...]
    stop: int
    within: int = 0
    terms: tuple[int, ...] = ()

    @staticmethod
    def of(specification: Specification, stop: int, within: int = 0) -> "Arrangement":
        """Return that of a specification, with the stop in some place."""
        bare = Arrangement(specification.groups, stop, within)
        if not any(specification.asphere_terms):
            return bare
        terms, before = [], AIR
        for behind in bare.media_behind:
            terms.append(specification.element_terms[behind if before == AIR else before])
            before = behind
        return Arrangement(specification.groups, stop, within, tuple(terms))

    @cached_property
    def sequence(self) -> tuple[int, ...]:
        """Return the refracting surfaces by their numbers from 0, and `STOP` where it stands."""
        found: list[int] = []
        surface = 0
        for number, elements in enumerate((*self.groups, 0)):
            end = surface + elements + (1 if number < len(self.groups) else 0)
            own = list(range(surface, end))
            if number == self.stop:
                own.insert(self.within, STOP)
            found += own
            surface = end
        return tuple(found)

    @cached_property
    def gap_media(self) -> tuple[int, ...]:
        """Return what each gap of the sequence is made of: an element's number from 0, or `AIR`."""
        behind = self.media_behind
        media, last = [], AIR
        for place in self.sequence[:-1]:
            last = last if place == STOP else behind[place]
            media.append(last)
        return tuple(media)

    @cached_property
    def media_behind(self) -> tuple[int, ...]:
        """Return what is behind each refracting surface: an element's number from 0, or `AIR`."""
        found: list[int] = []
        for elements in self.groups:
            first = sum(medium != AIR for medium in found)
            found += [*range(first, first + elements), AIR]
        return tuple(found)

    @property
    def surfaces(self) -> int:
        """Return the number of refracting surfaces."""
        return len(self.media_behind)

    @property
    def gaps(self) -> int:
        """Return the number of gaps between neighbours of the sequence."""
        return len(self.sequence) - 1

    @property
    def variables(self) -> int:
        """Return how many numbers tell a lens: curvatures, gaps, the sensor's distance, and the
        coefficients of aspheres.
        """
        return self.image_column + 1 + sum(self.terms)

    @property
    def image_column(self) -> int:
        """Return the column of the sensor's distance among the variables."""
        return self.surfaces + self.gaps

    def is_asphere(self, surface: int) -> bool:
        """Return whether a refracting surface, from 0, is an asphere."""
        return bool(self.terms) and self.terms[surface] > 0

    @property
    def aspheres(self) -> list[int]:
        """Return the refracting surfaces that are aspheres, from 0."""
        return [number for number in range(self.surfaces) if self.is_asphere(number)]

    @cached_property
    def coefficient_columns(self) -> tuple[range, ...]:
        """Return the columns of each refracting surface's aspheric coefficients."""
        found, first = [], self.image_column + 1
        for terms in self.terms or (0,) * self.surfaces:
            found.append(range(first, first + terms))
            first += terms
        return tuple(found)

    @cached_property
    def powers(self) -> tuple[int, ...]:
        """Return the power of the length in each variable's unit: -1 of a curvature, 1 of a gap,
        -3 of the coefficient of r⁴.
        """
        lengths = (1,) * (self.gaps + 1)
        coefficients = [-(2 * n + 3) for terms in self.terms for n in range(terms)]
        return (*(-1,) * self.surfaces, *lengths, *coefficients)

    @property
    def stop_place(self) -> int:
        """Return the place of the stop in the sequence."""
        return self.sequence.index(STOP)


def template(arrangement: Arrangement, specification: Specification, wide: float) -> Lens:
    """Return a lens of planes behind a plane on which rays start, its gaps one millimetre.

    Its surface 1 is the plane of the entrance pupil; those of the sequence follow.  Apertures clip
    nothing.

    Args:
        arrangement: the order.
        specification: gives wavelengths and glasses.
        wide: semi-diameter of all apertures, mm.
    """
    surfaces: dict[str, Mapping[str, Any]] = {
        "1": {"type": "plane", "semi_diameter": wide, "thickness": 1.0, "material": "air"}
    }
    media = [*(_medium(m, specification) for m in arrangement.gap_media), "air"]
    for number, (place, medium) in enumerate(zip(arrangement.sequence, media, strict=True), 2):
        shape: dict[str, Any] = {"type": "plane"}
        if place != STOP:
            shape = {"type": "sphere", "radius": 1e3 * wide}
            if arrangement.terms and arrangement.terms[place]:
                shape = asphere(1e-3 / wide, [0.0] * arrangement.terms[place])
        surfaces[str(number)] = {
            **shape,
            "semi_diameter": wide,
            "thickness": 1.0,
            "material": medium,
        }
    del surfaces[str(len(surfaces))]["thickness"]  # type: ignore[attr-defined]
    return lens_from_prescription(
        {
            "name": "template",
            "stop": arrangement.stop_place + 2,
            "wavelengths": list(specification.wavelengths),
            "surfaces": surfaces,
            "sensor": {"distance": 1.0, "diameter": 2.0 * wide},
        },
        dtype=torch.float64,
    )


def asphere(curvature: float, coefficients: Sequence[float]) -> dict[str, Any]:
    """Return an asphere of a search as a prescription has it.

    Args:
        curvature: 1/mm, not zero.
        coefficients: of r⁴, r⁶, ..., in mm^(1 - power).
    """
    powers = {f"a{2 * n + 4}": value for n, value in enumerate(coefficients)}
    return {"type": "even_asphere", "radius": 1.0 / curvature, "conic": -1.0, **powers}


def _medium(element: int, specification: Specification) -> str:
    return "air" if element == AIR else specification.element_glasses[element]


def parameter_names(arrangement: Arrangement) -> Sequence[str]:
    """Return the parameters of the template that vary: curvatures, then the distance from the
    plane of the entrance pupil to the first of the sequence, then gaps, the sensor's distance and
    the coefficients of aspheres.
    """
    curved = [n for n, place in enumerate(arrangement.sequence, 2) if place != STOP]
    return [
        *(f"surfaces.{number}.curvature" for number in curved),
        "thicknesses.*",
        "sensor_distance",
        *(
            f"surfaces.{number}.a{2 * n + 4}"
            for number, terms in zip(curved, arrangement.terms, strict=False)
            for n in range(terms)
        ),
    ]


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
