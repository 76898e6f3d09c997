"""What usual tolerances do to a found lens is one number, and the name of the worst of them.

The tolerances are those of `dolens.tolerancing.usual`, whose lengths are scaled to the lens.  The
spots of lenses as they would be made come from the linear ray model: no lens is traced again.
"""

from dataclasses import dataclass

import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.optics.lens import Lens
from dolens.plotting.tolerances import parameter_label
from dolens.tolerancing import (
    Yield,
    contributions,
    fields_all_around,
    linear_spots,
    quantiles,
    spot_weights,
    tolerances_from,
    usual_tolerances,
    usual_tolerances_text,
    with_glass_elements,
)

# Rings and arms of the rays of a spot; lenses that are drawn, by a generator with this seed.
_RINGS, _ARMS = 3, 8
_LENSES, _SEED = 500, 24
_SHARE = 0.9


@dataclass(frozen=True)
class LensSensitivity:
    """Says what usual tolerances do to a lens, refocused after it is made.

    Attributes:
        nominal_um: µm, RMS spot radius over all fields and wavelengths, as designed.
        expected_um: µm, the root of the mean square over lenses with all tolerances together.
        ninety_percent_um: µm, what 90 % of 500 lenses stay within, all drawn by the same numbers.
        worst: the parameter whose tolerance adds most: `element 3–4 tilt`, `1 curvature`.
        worst_share: its share of what all tolerances add to the mean square.
        tolerances: a sentence that says what they are.
    """

    nominal_um: float
    expected_um: float
    ninety_percent_um: float
    worst: str
    worst_share: float
    tolerances: str


def lens_sensitivity(lens: Lens) -> LensSensitivity:
    """Return what usual tolerances do to a lens, at its own fields and wavelengths.

    Fields are taken on all four sides of the axis, since a lens with tilted elements has no
    symmetry, and the two directions of a tilt or decenter are one offender.

    Args:
        lens: as designed, in double precision; it stays as it is.  Apertures clip the beams where
            they do so as designed.

    Raises:
        InputError: no light of a field passes.
    """
    where = conditions(lens)
    made = with_glass_elements(lens)
    tolerances = tolerances_from(made, usual_tolerances(made))
    fields = fields_all_around(where.fields.tolist(), where.field_weights.tolist())
    counts = where.weights > 0.0
    waves = where.wavelengths[counts].tolist()
    spots = gaussian_quadrature(
        made, list(fields), waves, _RINGS, _ARMS, where.object_distance, symmetry=False
    )
    of_fields = where.weights.new_tensor(list(fields.values()))
    weights = spot_weights(torch.outer(of_fields, where.weights[counts]).flatten(), spots.count)
    model = linear_spots(made, spots, tolerances.names)
    adding = contributions(model, tolerances, weights)
    errors = tolerances.draw(_LENSES, torch.Generator().manual_seed(_SEED))
    curves = model.focus_curves(errors)
    drawn = Yield.of(curves.at(curves.best_focus(weights)), weights)
    shares: dict[str, float] = {}
    for name, share in zip(tolerances.names, adding.share.tolist(), strict=True):
        label = parameter_label(name).removesuffix(" x").removesuffix(" y")
        shares[label] = shares.get(label, 0.0) + share
    worst = max(shares, key=lambda label: shares[label])
    return LensSensitivity(
        1e3 * adding.nominal**0.5,
        1e3 * adding.expected_rms,
        1e3 * quantiles(drawn.rms, [_SHARE])[0],
        worst,
        shares[worst],
        usual_tolerances_text(made),
    )
