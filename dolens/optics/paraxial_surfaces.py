"""What surfaces are to first-order optics: curvatures, and powers besides those of refraction."""

from collections.abc import Sequence

from torch import Tensor

from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem


def curvatures_of(
    system: OpticalSystem, first: int = 1, last: int | None = None
) -> list[Tensor | float]:
    """Return the paraxial curvatures (1/mm) of surfaces `first` to `last`, from 1."""
    return [s.shape.paraxial_curvature(s.parameters) for s in system.surfaces[first - 1 : last]]


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
        One power a surface, or None where none adds any.
    """
    surfaces = system.surfaces[first - 1 : last]
    if not deflects(surfaces):
        return None
    return [
        0.0
        if s.deflection is None
        else s.deflection.law.paraxial_power(s.deflection.parameters).at(wavelength)
        for s in surfaces
    ]


def deflects(surfaces: Sequence[SurfaceState]) -> bool:
    """Return whether any of the surfaces deflects light by a law of its own."""
    return any(s.deflection is not None for s in surfaces)
