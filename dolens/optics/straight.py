"""What only a lens of refracting surfaces along one axis allows is refused for any other."""

import math

from dolens.errors import InputError
from dolens.optics.system import OpticalSystem


def require_refracting(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where a lens has mirrors or coordinate breaks.

    Args:
        system: the lens.
        what: cannot be done with it; the message begins with it.
    """
    for numbers, kind in ((system.mirrors, "a mirror"), (system.breaks, "a coordinate break")):
        if numbers:
            raise InputError(
                f"{what}: surface {numbers[0]} is {kind}; only lenses of refracting surfaces along "
                "one axis are held there"
            )


def require_plane_sensor(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where the sensor of a lens is curved; arguments as above."""
    if system.image is not None:
        curvature = float(system.image.parameters["curvature"].detach())
        radius = math.copysign(math.inf, curvature) if curvature == 0.0 else 1.0 / curvature
        raise InputError(
            f"{what}: the sensor is curved (radius {radius:g} mm); only a plane one is held there"
        )
