"""A merit function as a configuration describes it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.spot_rays import SpotRays, gaussian_quadrature, square_grid, with_chief_rays
from dolens.optics.lens import Lens
from dolens.optimize.merit import MeritFunction
from dolens.optimize.operands import operand
from dolens.optimize.spot_residuals import SpotResiduals
from dolens.optimize.variables import DesignVariables

SAMPLINGS: dict[str, Callable[..., SpotRays]] = {
    "gaussian_quadrature": gaussian_quadrature,
    "square_grid": square_grid,
}


@dataclass(frozen=True)
class MeritSettings:
    """Which spots of a lens count, and what else it should be.

    Attributes:
        fields: (x, y), degrees or mm; None: the lens's own.
        wavelengths: nm; None: the lens's own.
        field_weights: one for each field; None: all equal.
        wavelength_weights: likewise.
        sampling: `gaussian_quadrature` or `square_grid`.
        sampling_options: what that function takes: `rings` and `arms`, or `count` and `half_width`.
        reference: deviations count from the spot's `centroid` or its `chief` ray.
        most_vignetted: share of a spot that apertures may clip; see `SpotResiduals`.
        operands: settings of each, as `dolens.optimize.operands.operand` takes them.
        spots: whether spots count at all.
    """

    fields: Sequence[Sequence[float]] | None = None
    wavelengths: Sequence[float] | None = None
    field_weights: Sequence[float] | None = None
    wavelength_weights: Sequence[float] | None = None
    sampling: str = "gaussian_quadrature"
    sampling_options: Mapping[str, Any] = field(default_factory=dict)
    reference: str = "centroid"
    most_vignetted: float = 0.2
    operands: Sequence[Mapping[str, Any]] = ()
    spots: bool = True

    def rays(self, lens: Lens) -> SpotRays:
        """The rays of all spots that pass the lens as it is now.

        Raises:
            InputError: no fields or wavelengths, or an unknown sampling or option.
        """
        if self.sampling not in SAMPLINGS:
            raise InputError(
                f"merit.sampling: '{self.sampling}' is unknown (allowed: {', '.join(SAMPLINGS)})"
            )
        fields = self.fields if self.fields is not None else _fields(lens)
        wavelengths = self.wavelengths if self.wavelengths is not None else lens.wavelengths
        if not wavelengths:
            raise InputError(f"merit.wavelengths: lens '{lens.name}' names none; give some (nm)")
        try:
            rays = SAMPLINGS[self.sampling](lens, fields, wavelengths, **self.sampling_options)
        except TypeError as error:
            raise InputError(f"merit.sampling_options: {error}") from None
        return with_chief_rays(lens, rays) if self.reference == "chief" else rays

    def weights(self, rays: SpotRays) -> Tensor:
        """(S,), of every spot; they sum to one."""
        number = len(rays.wavelengths.unique())
        of_fields = _weights("field_weights", self.field_weights, rays.count // number)
        of_waves = _weights("wavelength_weights", self.wavelength_weights, number)
        weights = (of_fields[:, None] * of_waves).reshape(-1)
        return weights / weights.sum()

    def build(self, lens: Lens, variables: DesignVariables) -> MeritFunction:
        """The merit function, over rays that pass the lens as it is now."""
        spots = None
        if self.spots:
            rays = self.rays(lens)
            spots = SpotResiduals(rays, self.weights(rays), self.reference, self.most_vignetted)
        operands = [operand(settings, lens) for settings in self.operands]
        if spots is None and not operands:
            raise InputError("merit: there are neither spots nor operands")
        return MeritFunction(lens, variables, spots, operands)


def _fields(lens: Lens) -> Sequence[Sequence[float]]:
    if lens.fields is None:
        raise InputError(f"merit.fields: lens '{lens.name}' names none; give (x, y) in degrees")
    return lens.fields.points


def _weights(what: str, given: Sequence[float] | None, count: int) -> Tensor:
    weights = torch.tensor([1.0] * count if given is None else list(given), dtype=torch.float64)
    if len(weights) != count or not bool((weights >= 0.0).all()) or not float(weights.sum()) > 0.0:
        raise InputError(f"merit.{what}: give {count} numbers that are not negative, not all zero")
    return weights
