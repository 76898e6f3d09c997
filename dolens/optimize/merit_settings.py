"""A configuration describes a merit function by these settings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions, conditions
from dolens.analysis.pupil_quadrature import (
    SpotRays,
    gaussian_quadrature,
    square_grid,
    with_chief_rays,
)
from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.lens import Lens
from dolens.optics.lens_states import check_state
from dolens.optimize.image_quality import REFERENCES, SPECTRA, ImageQuality, WavefrontResiduals
from dolens.optimize.merit import MeritFunction
from dolens.optimize.operands import (
    MOST_WEIGHT,
    Operand,
    check_angles,
    check_operand_fields,
    operand,
)
from dolens.optimize.ray_intercept_quality import (
    EncircledEnergy,
    LossResiduals,
    Modulation,
    RayInterceptLoss,
    RayInterceptResiduals,
    SpotSize,
)
from dolens.optimize.states import StatesMerit, VariablesInState, weights_of_states
from dolens.optimize.variables import DesignVariables
from dolens.typed_values import call_with_settings, check_types

SAMPLINGS: dict[str, Callable[..., SpotRays]] = {
    "gaussian_quadrature": gaussian_quadrature,
    "square_grid": square_grid,
}
# Residuals of rays, and losses of the points where they land.
RESIDUALS: dict[str, type[ImageQuality]] = {
    "spots": RayInterceptResiduals,
    "wavefront": WavefrontResiduals,
}
LOSSES = {"spot_size": SpotSize, "modulation": Modulation, "encircled_energy": EncircledEnergy}


@dataclass(frozen=True)
class MeritSettings:
    """Describes the spots of a lens that count, and the operands that constrain it.

    Attributes:
        fields: (x, y), degrees or mm; None: the lens's own.
        wavelengths: nm; None: the lens's own.
        field_weights: one for each field; None: the lens's own where the fields are, else all
            equal.  A field of weight zero has no rays.
        wavelength_weights: likewise.
        sampling: `gaussian_quadrature` or `square_grid`.
        sampling_options: what that function takes: `rings` and `arms`, or `count` and `half_width`;
            None leaves one at its default, in all options.
        quality: `spots`: RMS radii, µm; `wavefront`: RMS wavefront errors, wavelengths; a loss of
            ray intercepts: `modulation`, `encircled_energy`, `spot_size`, or an object that is
            called as `RayInterceptLoss` is; None: operands alone.
        quality_options: of a loss by name, see `dolens.optimize.ray_intercept_quality`; and the
            `curvature` of any loss, see `dolens.optimize.ray_intercept_quality`.
        reference: deviations count from the spot's `centroid` or its `chief` ray.
        reference_spectrum: `monochromatic`: each wavelength has a reference of its own; or
            `polychromatic`: one for all wavelengths of a field.
        max_vignetting: share of a spot that apertures may clip; see `ImageQuality`.
        operands: each by its settings, as `dolens.optimize.operands.operand` takes them, or as an
            object; one of a state has its name under `state`.
        states: of a lens that has some, those that count, together one problem; None: all.
        state_weights: one for each of them, of its rays' term; None: all equal.
    """

    fields: Sequence[Sequence[float]] | None = None
    wavelengths: Sequence[float] | None = None
    field_weights: Sequence[float] | None = None
    wavelength_weights: Sequence[float] | None = None
    sampling: str = "gaussian_quadrature"
    sampling_options: Mapping[str, Any] = field(default_factory=dict)
    quality: str | RayInterceptLoss | None = "spots"
    quality_options: Mapping[str, Any] = field(default_factory=dict)
    reference: str = "centroid"
    reference_spectrum: str = "monochromatic"
    max_vignetting: float = 0.2
    operands: Sequence[Mapping[str, Any] | Operand] = ()
    states: Sequence[str] | None = None
    state_weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        check_types(MeritSettings, vars(self), "merit")
        check_choice(self.sampling, SAMPLINGS, "merit.sampling")
        if self.quality is not None and not callable(self.quality):
            check_choice(self.quality, (*RESIDUALS, *LOSSES), "merit.quality")
        check_choice(self.reference, REFERENCES, "merit.reference")
        check_choice(self.reference_spectrum, SPECTRA, "merit.reference_spectrum")
        if not 0.0 <= self.max_vignetting <= 1.0:
            raise InputError(f"merit.max_vignetting: {self.max_vignetting}; allowed: 0 to 1")
        where = "merit.sampling_options"
        check_types(SAMPLINGS[self.sampling], _given(self.sampling_options), where)

    def conditions_of(self, lens: Lens) -> Conditions:
        """Return the fields and wavelengths that count, at the lens's own object distance.

        Raises:
            InputError: neither the settings nor the lens name fields or wavelengths, a field is not
                a pair, or weights do not fit.
        """
        points = self._all_fields(lens)
        waves = self.wavelengths if self.wavelengths is not None else lens.wavelengths
        if not waves:
            raise InputError(f"merit.wavelengths: lens '{lens.name}' names none; give some (nm)")
        require_wavelengths(waves, "merit.wavelengths")
        if self.wavelength_weights is not None:
            _weights("wavelength_weights", self.wavelength_weights, len(waves))
        found = conditions(lens, points, waves, wavelength_weights=self.wavelength_weights)
        shares = found.field_weights
        if self.field_weights is not None:
            shares = _weights("field_weights", self.field_weights, len(points))
        counts = shares > 0.0
        fields, shares = found.fields[counts], shares[counts] / shares.sum()
        return replace(found, fields=fields, field_weights=shares).that_count()

    def _all_fields(self, lens: Lens) -> Sequence[Sequence[float]]:
        if self.fields is not None:
            if not self.fields:
                raise InputError("merit.fields: is an empty list; give (x, y) in degrees")
            for point in self.fields:
                if len(point) != 2:
                    raise InputError(
                        f"merit.fields: {list(point)}; allowed: (x, y) in degrees or mm"
                    )
            distance = _given(self.sampling_options).get("object_distance", lens.object_distance)
            check_angles(self.fields, distance, "merit.fields")
            return self.fields
        if lens.fields is None:
            raise InputError(f"merit.fields: lens '{lens.name}' names none; give (x, y) in degrees")
        return lens.fields.points

    def rays(self, lens: Lens) -> SpotRays:
        """Return the rays of all spots that pass the lens as it is now.

        Raises:
            InputError: no fields or wavelengths, or an unknown sampling or option.
        """
        where = self.conditions_of(lens)
        spots = where.fields.tolist(), where.wavelengths.tolist()
        options = _given(self.sampling_options)
        if self.sampling == "gaussian_quadrature":
            options.setdefault("object_distance", lens.object_distance)
            # A loss sees all of a spot, not one half that stands for both.
            options.setdefault(
                "symmetry", not callable(self.quality) and self.quality not in LOSSES
            )
        elif lens.object_distance is not None:
            raise InputError(
                f"merit.sampling: '{self.sampling}' is for objects at infinity; lens "
                f"'{lens.name}' has object_distance {lens.object_distance:g} mm"
            )
        sampling = SAMPLINGS[self.sampling]
        rays = call_with_settings(sampling, options, "merit.sampling_options", lens, *spots)
        if self.reference == "chief":
            return with_chief_rays(lens, rays, lens.object_distance)
        return rays

    def weights(self, lens: Lens) -> Tensor:
        """Return the weight (S,) of every spot of `rays`; they sum to one."""
        where = self.conditions_of(lens)
        weights = torch.outer(where.field_weights, where.weights).flatten()
        return weights / weights.sum()

    def states_of(self, lens: Lens) -> dict[str, float]:
        """Return the states of a lens that count, with weights that sum to one; none of a lens
        without states.

        Raises:
            InputError: a state that the lens does not have, or weights that do not fit.
        """
        states = lens.state_names if self.states is None else tuple(self.states)
        for state in states:
            check_state(lens, state)
        if not states:
            if self.state_weights is not None:
                raise InputError(f"merit.state_weights: lens '{lens.name}' has no states")
            return {}
        return weights_of_states(states, self.state_weights)

    def build(self, lens: Lens, variables: DesignVariables) -> MeritFunction | StatesMerit:
        """Return the merit function, over rays that pass the lens as it is now.

        Raises:
            InputError: an unknown quality or option, or nothing that counts.
        """
        operands = [operand(settings, lens) for settings in self.operands]
        check_operand_fields(operands, lens.object_distance)
        if self.quality is None and not operands:
            raise InputError("merit: there are neither a quality nor operands")
        states = self.states_of(lens)
        if not states:
            return MeritFunction(lens, variables, self.image_quality(lens), operands)
        parts = {}
        for name, weight in states.items():
            there = lens.in_state(name)
            quality = self.image_quality(there)
            if quality is not None:
                quality = replace(quality, weights=quality.weights * weight)
            own = [o for o in operands if o.states is None or name in o.states]
            inside = VariablesInState(variables, lens, name)
            parts[name] = MeritFunction(there, inside, quality, own)
        return StatesMerit(lens, variables, parts)

    def image_quality(self, lens: Lens) -> ImageQuality | None:
        """Return the rays' term over rays that pass the lens as it is now; None without one."""
        if self.quality is None:
            return None
        own_loss = None if isinstance(self.quality, str) else self.quality
        name = self.quality if isinstance(self.quality, str) else ""
        rays = self.rays(lens)
        common = (
            rays,
            self.weights(lens),
            self.reference,
            self.reference_spectrum,
            self.max_vignetting,
        )
        options, where = _given(self.quality_options), "merit.quality_options"
        if own_loss is None and name in RESIDUALS:
            return call_with_settings(RESIDUALS[name], options, where, *common)
        curvature = options.pop("curvature", "directions")
        if own_loss is None:
            loss = call_with_settings(LOSSES[name], options, where)
            return LossResiduals(*common, loss, curvature)
        check_keys(options, ("curvature",), where)
        return LossResiduals(*common, own_loss, curvature)


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options without those that are None, which stand for a default."""
    return {key: value for key, value in options.items() if value is not None}


def _weights(what: str, given: Sequence[float] | None, count: int) -> Tensor:
    weights = torch.tensor([1.0] * count if given is None else list(given), dtype=torch.float64)
    bad = not bool(((weights >= 0.0) & (weights <= MOST_WEIGHT)).all())
    if len(weights) != count or bad or not float(weights.sum()) > 0.0:
        raise InputError(
            f"merit.{what}: give {count} numbers from 0 to {MOST_WEIGHT:g}, not all zero"
        )
    return weights
