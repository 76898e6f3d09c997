"""A lens is cut at its diffractive element: rays go to it, and waves leave it."""

from dataclasses import replace

import torch

from dolens.errors import InputError
from dolens.optics.diffractive import Relief
from dolens.optics.system import OpticalSystem, require_plane_sensor, require_refracting


def element_number(system: OpticalSystem) -> int:
    """Return the number of the surface whose relief waves pass, the only one.

    Raises:
        InputError: one line that says which of the conditions of this module a lens does not meet.
    """
    what = "diffractive element"
    found = system.diffractive
    if len(found) != 1:
        raise InputError(f"{what}: waves pass one, and there are {len(found)}: surfaces {found}")
    number = found[0]
    require_refracting(system, what)
    require_plane_sensor(system, what)
    if system.stop > number:
        raise InputError(f"{what}: the stop, surface {system.stop}, stands behind surface {number}")
    if any(element.last >= number for element in system.elements):
        raise InputError(f"{what}: surface {number}, or one behind it, belongs to a moved element")
    surface = system.surfaces[number - 1]
    flat = surface.shape.flat
    if not flat and (surface.deflection or not isinstance(surface.relief, Relief)):
        kind = surface.shape.kind
        raise InputError(f"{what}: surface {number} is no plane, but a {kind}")
    for at in range(number + 1, len(system.surfaces) + 1):
        surface = system.surfaces[at - 1]
        if not surface.shape.flat or surface.deflection is not None:
            raise InputError(
                f"{what}: surface {at} behind surface {number} is no plane; waves go from an "
                "element to the sensor through plane plates only (rays' order alone: `phase`)"
            )
    return number


def cut_at(system: OpticalSystem, number: int) -> OpticalSystem:
    """Return a lens that ends on one of its surfaces, which refracts and does nothing else, or on
    the plane that touches it at its vertex.
    """
    surfaces = [*system.surfaces[: number - 1]]
    surfaces.append(replace(system.surfaces[number - 1], deflection=None, relief=None))
    return replace(
        system,
        surfaces=surfaces,
        thicknesses=list(system.thicknesses[: number - 1]),
        sensor_distance=torch.zeros_like(system.sensor_distance),
        materials=system.materials[: number + 1],
        index_offsets=tuple(system.index_offsets[: number + 1]),
    )
