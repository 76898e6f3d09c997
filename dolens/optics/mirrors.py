"""A mirror stands in the place of the medium behind a surface, and light goes back where it came
from.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from dolens.errors import InputError


class Mirror:
    """A mirror is written where other surfaces have the medium behind them.

    There is one, `MIRROR`.  Light stays in the medium in front of the surface, and travels the
    other way along z behind it; so thicknesses behind one mirror are negative.
    """

    name = "mirror"

    def index(self, wavelength: object) -> float:
        """Raise `InputError`: the index is that of the medium in front of the mirror."""
        raise InputError("a mirror has no index; the medium behind it is the one in front of it")

    def __repr__(self) -> str:
        """Return its name."""
        return self.name

    def __copy__(self) -> "Mirror":
        """Return itself: there is one."""
        return self

    def __deepcopy__(self, memo: object) -> "Mirror":
        """Return itself: there is one."""
        return self

    def __reduce__(self) -> str:
        """Name the one mirror, for pickles."""
        return "MIRROR"


MIRROR = Mirror()


class Media(NamedTuple):
    """The media that light travels in, and the surfaces that reflect it.

    Attributes:
        materials: before surface 1 and behind each surface; behind a mirror, the one in front.
        mirrors: numbers of the surfaces that reflect, from 1.
    """

    materials: tuple[Any, ...]
    mirrors: tuple[int, ...]


def media_of(materials: Sequence[Any]) -> Media:
    """Resolve the mirrors in a lens's materials.

    Args:
        materials: before surface 1 and behind each surface; `MIRROR` behind one that reflects.

    Raises:
        InputError: there is a mirror before surface 1.
    """
    if materials[0] is MIRROR:
        raise InputError("the object cannot be in a mirror: 'object_material' is a medium")
    found, mirrors = [materials[0]], []
    for number, material in enumerate(materials[1:], 1):
        if material is MIRROR:
            mirrors.append(number)
        found.append(found[-1] if material is MIRROR else material)
    return Media(tuple(found), tuple(mirrors))
