"""Checks of a simulated alignment compare sampling and the pixels' grid with the noise."""

import math

import torch
from torch import Tensor

from dolens.alignment.element_fit import MeasuredMoments
from dolens.alignment.moments import Pixels, grid_error
from dolens.alignment.spot_moments import MomentModel

# Places of the pixels' grid that are tried.
_PLACES = 16


def sampling_error(
    fitted: MomentModel, simulated: MomentModel, errors: Tensor, measured: MeasuredMoments
) -> dict[str, float]:
    """Return the difference of moments by two quadratures of the same pupil, over their noise.

    Args:
        fitted: the model that is fitted.
        simulated: the one that is measured.
        errors: (K, P), of the lenses, in the lens's units.
        measured: K measurements.
    """
    difference = fitted.moments(errors, measured.origin) - simulated.moments(
        errors, measured.origin
    )
    apart = measured.over_noise(difference)
    return {
        "alignment/sampling_error_over_noise": float(apart.square().mean().sqrt()),
        "alignment/sampling_error_over_noise/largest": float(apart.abs().max()),
    }


def one_exposure_error(
    dense: MomentModel, pixels: Pixels, errors: Tensor, measured: MeasuredMoments
) -> dict[str, float]:
    """Return what one exposure instead of many dithered ones would change, over the noise.

    Places of the pixels' grid under the spots form a lattice.

    Args:
        dense: a model of many rays a pixel, without pixels.
        pixels: what counts the light.
        errors: (1, P), of one lens, in the lens's units.
        measured: its measurement.
    """
    side = (torch.arange(math.isqrt(_PLACES)) + 0.5) / math.isqrt(_PLACES)
    places = torch.cartesian_prod(side, side)
    difference = grid_error(
        dense.points(errors)[0],
        dense.shares,
        measured.origin[0],
        dense.size,
        pixels.pitch,
        places,
    )
    apart = measured.over_noise(difference[:, None])
    return {"alignment/pixel_grid_over_noise": float(apart.square().mean().sqrt())}
