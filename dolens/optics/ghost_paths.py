"""Ghost paths: light that surfaces of a lens reflect twice reaches the sensor beside the image.

A path is named by the surfaces that reflect, in the order of the light: (5, 3) goes through
surfaces 1 to 4, is reflected at 5, goes back through 4, is reflected at 3, and goes on through 4 to
the sensor.  A lens of N surfaces has N(N - 1)/2 such paths, and far more of four reflections, as
(5, 3, 6, 2).

Unfolded, a path is a sequence of surfaces as any other lens with mirrors, and all that is done with
lenses can be done with it (Abd El-Maksoud and Sasián, Proc. SPIE 7428, 742807, 2009).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.optics.coatings import Stack
from dolens.optics.elements import ElementState
from dolens.optics.image_surface import WITHOUT_EDGE
from dolens.optics.materials import Medium
from dolens.optics.surfaces.base import Surface
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.coordinate_break import CoordinateBreak, TiltFirstBreak
from dolens.optics.surfaces.plane import Plane
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem, require_one_index

Path = tuple[int, ...]
# Paths of many reflections are too many to count.
_MOST_BOUNCES = 6


def reflecting_surfaces(system: OpticalSystem, sensor: bool = False) -> tuple[int, ...]:
    """Return the numbers of the surfaces that reflect a part of the light that they refract.

    They part two media, and have no law of deflection of their own: of the light that a grating or
    an ideal lens reflects nothing is known.

    Args:
        system: the lens.
        sensor: whether the sensor reflects too; its number is one more than the last surface's.

    Raises:
        InputError: a medium is a crystal or a gradient.
    """
    require_one_index(system, "ghosts")
    count = len(system.surfaces)
    found = [n for n in range(1, count + 1) if _reflects(system, n)]
    return (*found, count + 1) if sensor else tuple(found)


def _reflects(system: OpticalSystem, number: int) -> bool:
    """Return whether a surface reflects a part of the light that it refracts."""
    if system.surfaces[number - 1].deflection is not None or number in system.mirrors:
        return False
    offsets = system.index_offsets[number - 1 : number + 1]
    return system.refracts(number) or any(offset is not None for offset in offsets)


def ghost_paths(system: OpticalSystem, bounces: int = 2, sensor: bool = False) -> list[Path]:
    """Return all paths of so many reflections, each as the surfaces that reflect.

    Args:
        system: the lens.
        bounces: 2, 4 or 6.
        sensor: whether the sensor reflects too.

    Raises:
        InputError: another number of reflections.
    """
    if bounces not in range(2, _MOST_BOUNCES + 1, 2):
        raise InputError(f"bounces: {bounces}; allowed: 2, 4 or 6")
    surfaces = reflecting_surfaces(system, sensor)
    paths: list[Path] = [()]
    for bounce in range(bounces):
        # Back at a surface farther on than the last that reflected, onwards at one before it.
        paths = [
            (*path, number)
            for path in paths
            for number in surfaces
            if not path or (number > path[-1] if bounce % 2 == 0 else number < path[-1])
        ]
    return paths


def check_path(system: OpticalSystem, path: Sequence[int], sensor: bool = True) -> Path:
    """Return a path as integers.

    Args:
        system: the lens.
        path: surfaces that reflect, in the order of the light.
        sensor: whether the sensor may be one of them.

    Raises:
        InputError: no even number of them, a surface that reflects nothing, or one that the light
            does not come to.
    """
    found = tuple(int(number) for number in path)
    if not found or len(found) % 2:
        raise InputError(f"ghost path {found}: an even number of surfaces reflect, as (5, 3)")
    known = reflecting_surfaces(system, sensor)
    for number in found:
        if number not in known:
            raise InputError(
                f"ghost path {found}: surface {number} reflects no light that it refracts "
                f"(allowed: {', '.join(map(str, known)) or 'none'})"
            )
    for bounce, (one, other) in enumerate(pairwise(found)):
        if not (one > other if bounce % 2 == 0 else one < other):
            raise InputError(
                f"ghost path {found}: light that surface {one} reflects does not come to {other}"
            )
    return found


class Unfolded(NamedTuple):
    """The surfaces that light meets on a path, one after the other.

    Attributes:
        numbers: of the surfaces.
        onwards: of each, whether light comes to it on the way to the sensor.
        bounces: places, from 0, of those that reflect it.
        media: in front of the first and behind each, as places in the lens's materials.
    """

    numbers: tuple[int, ...]
    onwards: tuple[bool, ...]
    bounces: frozenset[int]
    media: tuple[int, ...]

    def between(self, gaps: Sequence[Any], negative: Sequence[Any]) -> list[Any]:
        """Return the gaps between neighbours, of those behind each surface and their negatives."""
        return [
            gaps[one - 1] if other > one else negative[other - 1]
            for one, other in pairwise(self.numbers)
        ]


def unfolded(path: Path, last: int) -> Unfolded:
    """Return what light meets on a path; of (), all surfaces in their order.

    Args:
        path: surfaces that reflect.
        last: number of the last surface before the sensor.
    """
    numbers: list[int] = []
    onwards: list[bool] = []
    bounces: list[int] = []
    at = 0
    for end in (*path, last):
        step = 1 if end > at else -1
        numbers += range(at + step, end + step, step)
        onwards += [step > 0] * abs(end - at)
        bounces.append(len(numbers) - 1)
        at = end
    reflect = frozenset(bounces[:-1])
    media = [0]
    for place, (number, onward) in enumerate(zip(numbers, onwards, strict=True)):
        media.append(media[-1] if place in reflect else number if onward else number - 1)
    return Unfolded(tuple(numbers), tuple(onwards), reflect, tuple(media))


def ghost_path_system(
    system: OpticalSystem, path: Sequence[int], sensor: ClearAperture = WITHOUT_EDGE
) -> OpticalSystem:
    """Return a path as a sequence of surfaces.

    It holds the tensors of the lens, so that gradients flow to them: shapes, gaps with their signs,
    poses of elements, index offsets, coatings.  Light passes an aperture as often as it comes to
    it.  Mirrors of the lens reflect in either direction, and a coordinate break on the way back is
    undone.

    Path lengths through ideal lenses are those of the image's beam.

    Args:
        system: the lens.
        path: surfaces that reflect, in the order of the light; one more than the last surface's
            number is the sensor.
        sensor: what a sensor that reflects catches of the light.

    Raises:
        InputError: see `check_path`.
    """
    return next(ghost_path_systems(system, [check_path(system, path)], sensor))


def ghost_path_systems(
    system: OpticalSystem, paths: Sequence[Path], sensor: ClearAperture = WITHOUT_EDGE
) -> Iterator[OpticalSystem]:
    """Yield the systems of paths; see `ghost_path_system`.

    Args:
        system: the lens.
        paths: as `ghost_paths` gives them.
        sensor: what a sensor that reflects catches of the light.
    """
    onto_sensor = system.image
    if onto_sensor is None:
        onto_sensor = SurfaceState(Plane, {}, sensor)
    of_lens = [*system.surfaces, replace(onto_sensor, aperture=sensor)]

    @cache
    def met(number: int, onward: bool, bounces: bool) -> SurfaceState:
        """Return a surface as light comes to it; the same for all paths."""
        mirror = number in system.mirrors
        other = None
        if bounces and number <= len(system.surfaces):
            other = system.materials[number if onward else number - 1]
        return _as_met(of_lens[number - 1], onward or mirror, other)

    gaps = [*system.thicknesses, system.sensor_distance]
    negative = [-gap for gap in gaps]
    # An inner element comes before the one that holds it, also where both have one surface.
    elements = sorted(system.elements, key=lambda element: element.last - element.first)
    offsets = system.index_offsets
    for path in paths:
        way = unfolded(path, len(system.surfaces))
        numbers, turned = way.numbers, list(enumerate(way.numbers))
        yield replace(
            system,
            surfaces=[
                met(number, way.onwards[place], place in way.bounces) for place, number in turned
            ],
            thicknesses=way.between(gaps, negative),
            materials=[system.materials[medium] for medium in way.media],
            index_offsets=tuple(offsets[medium] for medium in way.media) if offsets else (),
            stop=numbers.index(system.stop) + 1,
            elements=[run for element in elements for run in _runs(element, numbers)],
            mirrors=tuple(p + 1 for p, n in turned if p in way.bounces or n in system.mirrors),
            reversals=tuple(p + 1 for p, n in turned if n in system.reversals),
        )


def _runs(element: ElementState, numbers: Sequence[int]) -> Iterator[ElementState]:
    """Yield an element once for each time that light comes to it.

    Its pivot counts from where its first surface is met for the first time.
    """
    first = numbers.index(element.first) + 1
    inside = [element.first <= number <= element.last for number in numbers]
    begin = None
    for place, within in enumerate([*inside, False], 1):
        if within and begin is None:
            begin = place
        elif not within and begin is not None:
            yield replace(element, first=begin, last=place - 1, origin=first)
            begin = None


def _as_met(surface: SurfaceState, onward: bool, other: Medium | None) -> SurfaceState:
    """Return a surface as light comes to it.

    Args:
        surface: as the lens has it.
        onward: whether light comes on the way to the sensor, or to a mirror.
        other: the medium on the far side of a surface that reflects a part of the light.
    """
    if surface.shape.changes_axes:
        return surface if onward else _undone(surface)
    coating = surface.coating
    if coating is not None:
        coating = coating if onward else coating.turned_round()
        coating = coating if other is None else replace(coating, substrate=other)
    return surface if coating is surface.coating else replace(surface, coating=coating)


def with_losses(system: OpticalSystem) -> OpticalSystem:
    """Return the lens with bare glass where a surface has no coating: an ideal one, which passes
    all light, makes no ghosts.
    """
    surfaces = [
        replace(surface, coating=Stack())
        if surface.coating is None and _reflects(system, number)
        else surface
        for number, surface in enumerate(system.surfaces, 1)
    ]
    return replace(system, surfaces=surfaces)


def _undone(surface: SurfaceState) -> SurfaceState:
    """Return the coordinate break that undoes another one.

    Raises:
        InputError: it is of a kind that has no inverse here.
    """
    inverse: dict[type[Surface], type[Surface]] = {
        CoordinateBreak: TiltFirstBreak,
        TiltFirstBreak: CoordinateBreak,
    }
    shape = inverse.get(surface.shape)
    if shape is None:
        raise InputError(
            f"ghost paths: a {surface.shape.__name__} cannot be passed backwards (allowed: "
            "coordinate breaks of either order)"
        )
    parameters = {name: -value for name, value in surface.parameters.items()}
    return replace(surface, shape=shape, parameters=parameters)
