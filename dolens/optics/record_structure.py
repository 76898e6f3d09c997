"""The structure of a lens is what the layout of its table's records depends on.

It stays while a lens is optimised: kinds of surfaces, apertures, media, which elements carry what.
"""

from typing import NamedTuple

import torch

from dolens.optics.materials import Medium
from dolens.optics.surfaces.clear_aperture import ClearAperture

# Stands in a `Form` for the code of a kernel.
BREAK = -1


class Form(NamedTuple):
    """A shape without its numbers; see `PackedShape`.

    Attributes:
        kind: the code of its kernel, or `BREAK` of a coordinate break, which is no step.
        count: as in `PackedShape`, and the three that follow.
        columns: of a spline; 1 for a polynomial with a b·z² term.
        degree: highest power of x or y.
        extras: further integers.
        sizes: the shape of each number's tensor; None: the number is zero.
        data: as in `PackedShape`.
    """

    kind: int
    count: int  # type: ignore[assignment]  # a tuple has a method of that name
    columns: int
    degree: int
    extras: tuple[int, ...]
    sizes: tuple[torch.Size | None, ...]
    data: int = 0


class LawForm(NamedTuple):
    """A law of deflection without its numbers.

    Attributes:
        code: of its kernel.
        sizes: the shape of each number's tensor; None: the number is zero.
    """

    code: int
    sizes: tuple[torch.Size | None, ...]


class Structure(NamedTuple):
    """The structure of a lens, which the layout of the records depends on.

    Attributes:
        forms: of all the lens's surfaces.
        apertures: of all of them.
        materials: before surface 1 and after each surface.
        elements: first and last surface of each element.
        mirrors: numbers of the surfaces that reflect.
        senses: of the light in each medium, +1 towards +z and -1 towards -z, in forward mode.
        sense: +1 from the object towards the sensor, -1 backwards.
        first: number of the first surface that is packed, as the prescription counts.
        last: number of the last.
        to_sensor: go on to the sensor plane (forward only).
        laws: what deflects light at each surface in the place of Snell's law, or None.
        image: of the curved surface that rays end on; None of a plane, and short of the sensor.
    """

    forms: tuple[Form, ...]
    apertures: tuple[ClearAperture, ...]
    materials: tuple[Medium, ...]
    elements: tuple[tuple[int, int], ...]
    mirrors: tuple[int, ...]
    senses: tuple[float, ...]
    sense: float
    first: int
    last: int
    to_sensor: bool
    laws: tuple[LawForm | None, ...]
    image: Form | None = None
