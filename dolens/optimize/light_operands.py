"""Operands of lost light: what coatings reflect, and what of a field's light passes the lens."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dolens.analysis.transmission import reflectances
from dolens.errors import InputError
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.lens import Lens
from dolens.optics.trace import enter_lens, trace_surfaces, trace_to_sensor
from dolens.optimize.operands import LensProperties, Operand


@dataclass(frozen=True)
class Reflectance(Operand):
    """Is what coated surfaces reflect of unpolarised light, per cent.

    Attributes:
        surfaces: their numbers; None: all that have a coating.
        wavelengths: nm; None: the reference wavelength.
        angles: degrees of incidence in front of the surface.
    """

    keys: ClassVar[tuple[str, ...]] = ("surfaces", "wavelengths", "angles")
    surfaces: Sequence[int] | None = None
    wavelengths: Sequence[float] | None = None
    angles: Sequence[float] = (0.0,)

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f"operand '{self.kind}'"
        require_wavelengths(self.wavelengths or (), where)
        if not self.angles or not all(0.0 <= angle < 90.0 for angle in self.angles):
            raise InputError(f"{where}: angles must be from 0 to 90 degrees, not {self.angles}")

    def check(self, lens: Lens) -> None:
        """Raise `InputError` where a surface has no coating, or none has one."""
        coated = [int(n) for n, s in lens.surfaces.items() if s.coating is not None]
        for number in self.surfaces or ():
            if number not in coated:
                raise InputError(
                    f"operand '{self.kind}': surface {number} has no coating (allowed: {coated})"
                )
        if not coated:
            raise InputError(f"operand '{self.kind}': no surface of the lens has a coating")

    def values(self, lens: LensProperties) -> dict[str, Tensor]:
        """Return what each surface reflects at each wavelength and angle."""
        waves = self.wavelengths or (lens.wavelength,)
        return {
            f"{self.kind}/{number}/{nm:g}/{angle:g}": 100.0 * share
            for number, shares in reflectances(lens.system, waves, self.angles).items()
            if self.surfaces is None or number in self.surfaces
            for nm, row in zip(waves, shares, strict=True)
            for angle, share in zip(self.angles, row.unbind(), strict=True)
        }


@dataclass(frozen=True)
class TransmissionOfChiefRay(Operand):
    """Is what passes the lens of the unpolarised light of a field's chief ray, per cent.

    Attributes:
        wavelengths: nm; None: the reference wavelength.
    """

    keys: ClassVar[tuple[str, ...]] = ("wavelengths",)
    wavelengths: Sequence[float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_wavelengths(self.wavelengths or (), f"operand '{self.kind}'")

    def values(self, lens: LensProperties) -> dict[str, Tensor]:
        """Return the share at each wavelength.

        Raises:
            UnreachableField: the chief ray does not reach the stop.
        """
        system, aimed = lens.system, lens.aimed_chief_ray(self.field)
        x, y = self.field
        ray, _ = enter_lens(system, aimed, 1, 1.0)
        found = {}
        for nm in self.wavelengths or (lens.wavelength,):
            traced = trace_surfaces(system, ray, nm, transmission=True)
            traced = trace_to_sensor(system, traced, nm)
            share = torch.full_like(traced.ray.x, 100.0)
            for medium, surface in traced.shares or ():
                share = share * medium * surface
            found[f"{self.kind}/{x:g},{y:g}/{nm:g}"] = share
        return found
