"""What surfaces, gaps, media and elements must be, so that they make a lens."""

from collections.abc import Mapping, Sequence

from dolens.errors import InputError
from dolens.optics.elements import Element, check_elements
from dolens.optics.materials import Medium
from dolens.optics.mirrors import MIRROR, media_of
from dolens.optics.surfaces.base import Surface


def check_lens(
    surfaces: Sequence[Surface],
    thicknesses: Sequence[float],
    materials: Sequence[Medium],
    stop: int,
    elements: Mapping[str, Element],
) -> None:
    """Raise `InputError` where the parts of a lens do not go together; see `Lens`.

    The numbers of gaps and media must be those of the surfaces, the stop one of them that light
    meets, mirrors without a law of their own, and a coordinate break within one medium.
    """
    count = len(surfaces)
    if count == 0 or len(thicknesses) != count - 1 or len(materials) != count + 1:
        raise InputError(
            f"{count} surfaces need {count - 1} thicknesses and {count + 1} "
            f"materials, not {len(thicknesses)} and {len(materials)}"
        )
    if not 1 <= stop <= count:
        raise InputError(f"stop must be a surface from 1 to {count}, not {stop}")
    media = media_of(tuple(materials)).materials
    for number, (surface, medium) in enumerate(zip(surfaces, materials[1:], strict=True), 1):
        if surface.law is not None and medium is MIRROR:
            raise InputError(f"surface {number}: a {surface.law.kind} cannot be a mirror")
    check_elements(elements, count)
    if all(surface.changes_axes for surface in surfaces):
        raise InputError("there is no surface but coordinate breaks")
    for number, surface in enumerate(surfaces, 1):
        if not surface.changes_axes:
            continue
        place = f"surface {number} is a coordinate break"
        if number == stop:
            raise InputError(f"{place}, and cannot be the stop")
        if media[number] != media[number - 1]:
            raise InputError(f"{place}; the medium behind it is the one in front of it")
