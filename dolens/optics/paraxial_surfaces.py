"""What surfaces are to first-order optics: curvatures, and powers besides those of refraction."""

from collections.abc import Sequence

from torch import Tensor

from dolens.optics.paraxial_recurrence import Number
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem


def curvatures_of(
    system: OpticalSystem, first: int = 1, last: int | None = None
) -> list[Tensor | float]:
    """Return the paraxial curvatures (1/mm) of surfaces `first` to `last`, from 1: the means over
    azimuth, or those along the system's meridian.
    """
    return [
        s.shape.paraxial_curvature(s.parameters)
        if system.meridian is None or s.shape.rotational
        else s.shape.section_curvature(s.parameters, *_direction(system, number))
        for number, s in _numbered(system, first, last)
    ]


def powers_of(
    system: OpticalSystem, wavelength: float | Tensor, first: int = 1, last: int | None = None
) -> list[Tensor | float] | None:
    """Return the powers (1/mm) that phases and ideal lenses add to surfaces `first` to `last`.

    Args:
        system: the lens.
        wavelength: nm.
        first: number of the first surface, from 1.
        last: number of the last; None: of the lens.

    Returns:
        One power a surface, or None where none adds any: the mean over azimuth, or that along the
        system's meridian.
    """
    if not deflects(system.surfaces[first - 1 : last]):
        return None
    found: list[Tensor | float] = []
    for number, surface in _numbered(system, first, last):
        own = surface.deflection
        if own is None:
            found.append(0.0)
        elif system.meridian is None or own.law.rotational:
            found.append(own.law.paraxial_power(own.parameters).at(wavelength))
        else:
            way = _direction(system, number)
            found.append(own.law.section_power(own.parameters, *way).at(wavelength))
    return found


def _numbered(
    system: OpticalSystem, first: int, last: int | None
) -> list[tuple[int, SurfaceState]]:
    return list(enumerate(system.surfaces, 1))[first - 1 : last]


def _direction(system: OpticalSystem, number: int) -> tuple[Number, Number]:
    """Return the direction (x, y) of the system's meridian in a surface's own axes, of length one.

    Turns about z turn it; of other tilts, as of a fold, the lens is unfolded along its axis.
    """
    along_x = system.meridian == "x"
    rotation = system.axes[number - 1].rotation
    if rotation is None:
        return (1.0, 0.0) if along_x else (0.0, 1.0)
    # Of the lens's x and y the one that lies more across the surface's axis tells the turn.
    x, y = rotation[0, :2], rotation[1, :2]
    if float(x.norm()) >= float(y.norm()):
        cosine, sine = (x / x.norm()).unbind()
    else:
        cosine, sine = (y / y.norm()).flip(0).unbind()
        sine = -sine
    return (cosine, sine) if along_x else (-sine, cosine)


def deflects(surfaces: Sequence[SurfaceState]) -> bool:
    """Return whether any of the surfaces deflects light by a law of its own."""
    return any(s.deflection is not None for s in surfaces)
