"""An arrangement is the order of elements, air spaces and the stop, without numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

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
    """

    groups: tuple[int, ...]
    stop: int
    within: int = 0

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
        """Return how many numbers tell a lens: curvatures, gaps and the sensor's distance."""
        return self.surfaces + self.gaps + 1

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


def _medium(element: int, specification: Specification) -> str:
    return "air" if element == AIR else specification.element_glasses[element]


def parameter_names(arrangement: Arrangement) -> Sequence[str]:
    """Return the parameters of the template that vary: curvatures, then the distance from the
    plane of the entrance pupil to the first of the sequence, then gaps and the sensor's distance.
    """
    curved = [n for n, place in enumerate(arrangement.sequence, 2) if place != STOP]
    return [
        *(f"surfaces.{number}.curvature" for number in curved),
        "thicknesses.*",
        "sensor_distance",
    ]
