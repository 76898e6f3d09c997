"""The rays of a lens's fields, paraxial and real, and what follows from the paraxial ones."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.aiming import AimedRays, aim
from dolens.optics.paraxial import FirstOrder, first_order, vergence
from dolens.optics.paraxial_rays import ParaxialRays, paraxial_rays
from dolens.optics.seidel import Seidel, seidel
from dolens.optics.system import OpticalSystem


class LensRays:
    """Methods of `Lens` about the rays of a field.

    A field is an angle in degrees for an object at infinity, else a point of the object in mm.
    """

    dtype: torch.dtype
    device: torch.device
    system: Callable[[], OpticalSystem]

    def first_order(
        self,
        wavelength: float | Tensor = 587.5618,
        object_distance: float | Tensor | None = None,
        meridian: str | None = None,
    ) -> FirstOrder:
        """EFL, cardinal points, pupils, F-number, magnification at a wavelength in nm.

        Args:
            wavelength: nm.
            object_distance: mm, or None for infinity.
            meridian: `x` or `y`, the section that they are of; None: of a lens whose sections
                differ, those of the mean curvatures over azimuth.
        """
        return first_order(self.system().section(meridian), wavelength, object_distance)

    def paraxial_rays(
        self,
        field: float | Tensor,
        wavelength: float | Tensor = 587.5618,
        object_distance: float | Tensor | None = None,
    ) -> ParaxialRays:
        """Paraxial marginal and chief ray at every surface, and Lagrange's invariant.

        Args:
            field: along y, degrees or mm.
            wavelength: nm.
            object_distance: mm, or None for infinity.
        """
        field = self._field(field, object_distance)
        return paraxial_rays(self.system(), wavelength, field, object_distance)

    def seidel(
        self,
        field: float | Tensor,
        wavelength: float | Tensor = 587.5618,
        object_distance: float | Tensor | None = None,
        color: tuple[float, float] = (486.1327, 656.2725),
    ) -> Seidel:
        """Seidel sums in mm of wave aberration, surface by surface; `.total` is the lens's.

        Args:
            field: edge of the field, degrees or mm.
            wavelength: nm.
            object_distance: mm, or None for infinity.
            color: shorter and longer wavelength of the chromatic sums, nm.
        """
        field = self._field(field, object_distance)
        return seidel(self.system(), wavelength, field, object_distance, color)

    def aim(
        self,
        field: Sequence[float] | Tensor,
        pupil: Sequence[float] | Tensor,
        wavelength: float | Tensor = 587.5618,
        object_distance: float | Tensor | None = None,
    ) -> AimedRays:
        """Real rays that cross the stop at given points; see `dolens.optics.aiming`.

        Args:
            field: (..., 2), degrees or mm.
            pupil: (..., 2), x and y on the stop over its semi-diameter.
            wavelength: nm, a number or (...).
            object_distance: mm, or None for infinity.
        """
        options: dict[str, Any] = {"dtype": self.dtype, "device": self.device}
        field = self._field(field, object_distance)
        pupil = torch.as_tensor(pupil, **options)
        for what, values in (("field", field), ("pupil", pupil)):
            if values.shape[-1:] != (2,):
                raise InputError(f"{what} must be x and y, (..., 2), not {tuple(values.shape)}")
        return aim(self.system(), field, pupil, wavelength, object_distance)

    def chief_ray(
        self,
        field: Sequence[float] | Tensor,
        wavelength: float | Tensor = 587.5618,
        object_distance: float | Tensor | None = None,
    ) -> AimedRays:
        """The real ray of a field, (..., 2), through the centre of the stop; see `aim`."""
        return self.aim(field, (0.0, 0.0), wavelength, object_distance)

    def marginal_rays(
        self,
        field: Sequence[float] | Tensor,
        wavelength: float | Tensor = 587.5618,
        object_distance: float | Tensor | None = None,
    ) -> AimedRays:
        """Real rays of a field, (..., 2), to the stop's edge: upper, lower, sagittal, (..., 3).

        They cross it at +y, -y and +x; `wavelength` broadcasts with (..., 3).
        """
        field = torch.as_tensor(field, dtype=self.dtype, device=self.device)[..., None, :]
        edge = field.new_tensor([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]])
        return self.aim(field, edge, wavelength, object_distance)

    def _field(
        self, field: float | Sequence[float] | Tensor, object_distance: float | Tensor | None
    ) -> Tensor:
        """Radians for an object at infinity, mm for a finite one."""
        field = torch.as_tensor(field, dtype=self.dtype, device=self.device)
        near = torch.as_tensor(vergence(object_distance), dtype=self.dtype, device=self.device)
        near = near[..., None] if near.ndim else near
        return torch.where(near == 0.0, torch.deg2rad(field), field)
