"""Fields and wavelengths of an analysis, as a caller gives them, and how much each wavelength
counts.

A wavelength of weight zero does not count in a polychromatic value at all: the value is what it
would be, were the wavelength not there.  What is shown of each wavelength alone knows no weights.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence

FieldPoints = float | Sequence[float] | Sequence[Sequence[float]] | Tensor


def field_points(fields: FieldPoints) -> Tensor:
    """Return field points (F, 2), float64, of points, of numbers along y, or of one number.

    Raises:
        InputError: another shape, none at all, or numbers that are not finite.
    """
    message = f"fields must be numbers along y or pairs (x, y), at least one, not {fields}"
    try:
        points = torch.as_tensor(fields, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError):
        raise InputError(message) from None
    if points.ndim < 2:
        points = points.reshape(-1)
        points = torch.stack((torch.zeros_like(points), points), -1)
    if points.ndim != 2 or points.shape[-1] != 2 or not len(points):
        raise InputError(message)
    if not bool(torch.isfinite(points).all()):
        raise InputError(message)
    return points


def field_unit(object_distance: float | None) -> str:
    """Return the unit of field coordinates: `°` for an object at infinity, else `mm`."""
    return "°" if vergence(object_distance) == 0.0 else "mm"


def as_wavelengths(wavelengths: float | Sequence[float] | Tensor) -> Tensor:
    """Return wavelengths (W,), nm, in double precision on the CPU.

    Raises:
        InputError: none, or one that no light has; see `require_wavelengths`.
    """
    message = f"wavelengths must be numbers (nm), at least one, not {wavelengths}"
    try:
        waves = torch.as_tensor(wavelengths, dtype=torch.float64).detach().cpu().reshape(-1)
    except (TypeError, ValueError):
        raise InputError(message) from None
    if len(waves) == 0:
        raise InputError(message)
    require_wavelengths(waves.tolist())
    return waves


def spectral_shares(
    lens: Lens,
    wavelengths: Sequence[float] | Tensor,
    weights: Sequence[float] | Tensor | None = None,
) -> Tensor:
    """Return the shares (W,) of wavelengths in polychromatic values, float64; they sum to one.

    Args:
        lens: whose own weights count where none are given and the wavelengths are its own, in any
            order; other wavelengths then count alike.
        wavelengths: (W,), nm.
        weights: (W,), of any sum.

    Raises:
        InputError: another number of weights, a negative one, or none that is positive.
    """
    waves = as_wavelengths(wavelengths)
    if weights is None:
        weights = _own_weights(lens, waves)
    shares = torch.as_tensor(weights, dtype=torch.float64).cpu()
    good = shares.shape == waves.shape and bool((shares.isfinite() & (shares >= 0.0)).all())
    if not good or not float(shares.sum()) > 0.0:
        raise InputError(
            f"wavelength_weights must be {len(waves)} weights, none negative and not all zero, not "
            f"{weights}"
        )
    return shares / shares.sum()


def _own_weights(lens: Lens, waves: Tensor) -> Sequence[float] | Tensor:
    """Return the lens's weights of its own wavelengths; ones for others."""
    own = torch.tensor(lens.wavelengths or (), dtype=torch.float64)
    alike = torch.ones_like(waves)
    if lens.wavelength_weights is None or own.shape != waves.shape:
        return alike
    here, there = waves.argsort(stable=True), own.argsort(stable=True)
    # Wavelengths may have been in single precision.
    if not torch.allclose(waves[here], own[there], rtol=1e-6, atol=0.0):
        return alike
    weights = torch.as_tensor(lens.wavelength_weights, dtype=torch.float64)
    if weights.shape != own.shape:
        return lens.wavelength_weights
    return alike.index_copy(0, here, weights[there])
