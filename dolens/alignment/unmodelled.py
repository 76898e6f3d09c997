"""A real measurement has effects that the model of a pose fit has not."""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.materials import Medium, is_glass
from dolens.typed_values import call_with_settings


@dataclass(frozen=True)
class Unmodelled:
    """Describes effects of a real measurement that a pose fit does not model; all are absent by
    default.

    Attributes:
        radius: tolerance of every surface's radius of curvature, relative; the error is uniform
            within ± this share.
        index: tolerance of every glass's refractive index; the error is uniform within ± this
            number, and the same at all wavelengths.
        source_diameter: of a disc that radiates evenly, normal to the z axis and about the place of
            the source, mm; 0: a point.
        background: mean of the light besides the source's, photo-electrons a pixel, with its shot
            noise.
        diffraction: photons land as the irradiance of wave optics has it, not as rays do.

    Raises:
        InputError: a number out of range.
    """

    radius: float = 0.0
    index: float = 0.0
    source_diameter: float = 0.0
    background: float = 0.0
    diffraction: bool = False

    def __post_init__(self) -> None:
        for name, high in (("radius", 0.5), ("index", 0.2)):
            if not 0.0 <= getattr(self, name) <= high:
                raise InputError(
                    f"unmodelled.{name}: {getattr(self, name)}; allowed: from 0 to {high:g}"
                )
        for name in ("source_diameter", "background"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise InputError(f"unmodelled.{name}: {getattr(self, name)}; allowed: 0 or more")
        if not isinstance(self.diffraction, bool):
            raise InputError(
                f"unmodelled.diffraction: {self.diffraction!r}; allowed: true or false"
            )

    @property
    def of_the_lens(self) -> bool:
        """Return whether the lens differs from its design."""
        return self.radius > 0.0 or self.index > 0.0

    def made(self, lens: Lens, generator: torch.Generator) -> Lens:
        """Return a copy of a lens with radii and indices as they might be made.

        A radius R becomes R·(1 + ε), a plane stays plane; the index n of a glass becomes n + δ.
        Surfaces that have the same glass have the same error of its index.  The generator gives
        one number for each surface and one for each glass, whatever the tolerances are, so that
        equal states of it give errors in proportion to the tolerances.

        Args:
            lens: as designed; it stays as it is.
            generator: on the CPU.
        """
        found = copy.deepcopy(lens)
        glasses = [m for m in dict.fromkeys(lens.materials) if is_glass(m)]
        count = len(found.surfaces) + len(glasses)
        shares = 2.0 * torch.rand(count, generator=generator, dtype=torch.float64) - 1.0
        own, melts = shares[: len(found.surfaces)], shares[len(found.surfaces) :]
        with torch.no_grad():
            for surface, share in zip(found.surfaces.values(), own.tolist(), strict=True):
                curvature = getattr(surface, "curvature", None)
                if curvature is not None:
                    curvature.div_(1.0 + self.radius * share)
        shifted = {
            glass: ShiftedMedium(glass, self.index * share)
            for glass, share in zip(glasses, melts.tolist(), strict=True)
        }
        media: list[Any] = [shifted.get(medium, medium) for medium in lens.materials]
        found.materials = tuple(media)
        return found


@dataclass(frozen=True)
class ShiftedMedium:
    """Shifts the index of a medium by the same number at every wavelength."""

    medium: Medium
    shift: float

    @property
    def name(self) -> str:
        """Return the medium's name, and by how much it is off."""
        return f"{self.medium.name}{self.shift:+g}"

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Return the refractive index at a wavelength in nm."""
        return self.medium.index(wavelength) + self.shift


def unmodelled_of(settings: Mapping[str, Any] | None, key: str = "unmodelled") -> Unmodelled:
    """Return the effects that a configuration describes; none of them where there are no settings.

    Args:
        settings: of `Unmodelled`.
        key: of the configuration that an error names.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    return call_with_settings(Unmodelled, settings or {}, key)
