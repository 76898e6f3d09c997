"""Jones matrices and Stokes vectors: what they do to polarised light, and ideal elements.

Fields are (E_x, E_y) with time as exp(-iωt), so that light is later by δ where its phase is greater
by δ.  Angles run from x towards y.  Stokes vectors are (S₀, S₁, S₂, S₃) as in Born and Wolf, 1.4.2:
S₁ > 0 along x, S₂ > 0 along x + y, S₃ > 0 for right-handed light, whose field turns clockwise to
who looks towards the source: S₃ = -2·Im(E_x*·E_y).
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError, check_keys, comma_hint

_COMPLEX = torch.complex128
# tr(σ·JJ†) for S₀ to S₃.
_PAULI = torch.tensor(
    [[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]], dtype=_COMPLEX
)
_ELEMENTS = {"polariser": ("extinction",), "retarder": ("retardance",)}


def polariser(angle: float, extinction: float = 0.0) -> Tensor:
    """Return the Jones matrix (2, 2) of a linear polariser, complex128.

    Args:
        angle: of the axis that passes all, degrees.
        extinction: share of the power that passes across it.
    """
    return _element(angle, 1.0, math.sqrt(extinction))


def retarder(angle: float, retardance: float) -> Tensor:
    """Return the Jones matrix (2, 2) of a linear retarder, complex128.

    Args:
        angle: of the fast axis, degrees.
        retardance: degrees; light along the slow axis is later by it.
    """
    fast = cmath.exp(-0.5j * math.radians(retardance))
    return _element(angle, fast, fast.conjugate())


def _element(angle: float, along: complex, across: complex) -> Tensor:
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    turn = torch.tensor([[c, -s], [s, c]], dtype=_COMPLEX)
    return turn @ torch.diag(torch.tensor([along, across], dtype=_COMPLEX)) @ turn.mT


def ideal_elements(given: Sequence[Mapping[str, Any]], where: str) -> Tensor:
    """Return the Jones matrix (2, 2) of ideal elements one behind the other.

    Args:
        given: in the order of the light; each `{"polariser": angle}` with `extinction` by choice,
            or `{"retarder": angle, "retardance": ...}`, in degrees.
        where: they stand; messages begin with it.

    Raises:
        InputError: an element that is none of these, or a number that cannot be used.
    """
    found = torch.eye(2, dtype=_COMPLEX)
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise InputError(f"{where}: must be a list of elements, not one")
    for number, element in enumerate(given, 1):
        place = f"{where}: element {number}"
        if not isinstance(element, Mapping) or not element:
            raise InputError(f"{place}: must be {{'polariser': angle}} or {{'retarder': angle}}")
        kinds = [kind for kind in _ELEMENTS if kind in element]
        if len(kinds) != 1:
            check_keys(element, _ELEMENTS, place)
            raise InputError(f"{place}: must be one of {', '.join(_ELEMENTS)}")
        kind = kinds[0]
        check_keys(element, (kind, *_ELEMENTS[kind]), place)
        numbers = {key: _number(value, f"{place}: {key}") for key, value in element.items()}
        if kind == "retarder" and "retardance" not in numbers:
            raise InputError(f"{place}: 'retardance' is missing, degrees")
        if not 0.0 <= numbers.get("extinction", 0.0) <= 1.0:
            raise InputError(f"{place}: 'extinction' must be 0 to 1, not {element['extinction']}")
        angle = numbers.pop(kind)
        found = (polariser if kind == "polariser" else retarder)(angle, **numbers) @ found
    return found


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: must be a number, not {value!r}{comma_hint(value)}")
    return float(value)


def mean_transmission(jones: Tensor) -> Tensor:
    """Return the share of unpolarised light that Jones matrices (..., 2, 2) pass, (...)."""
    return 0.5 * torch.view_as_real(jones).square().sum((-1, -2, -3))


def diattenuation(jones: Tensor) -> tuple[Tensor, Tensor]:
    """Return (T_max - T_min)/(T_max + T_min), and the angle of the axis that passes most, degrees.

    Args:
        jones: (..., 2, 2).

    Returns:
        Both (...); the axis is that of the linear part, -90 to 90.
    """
    power = jones.mH @ jones
    total = (power[..., 0, 0] + power[..., 1, 1]).real
    first = (power[..., 0, 0] - power[..., 1, 1]).real
    second, third = 2.0 * power[..., 0, 1].real, 2.0 * power[..., 0, 1].imag
    size = torch.sqrt(first * first + second * second + third * third)
    return size / total, torch.rad2deg(0.5 * torch.atan2(second, first))


def retardance(jones: Tensor) -> tuple[Tensor, Tensor]:
    """Return the retardance, and the angle of the fast axis, both in degrees.

    It is that of the unitary factor U of the polar decomposition J = U·H (Lu and Chipman, J. Opt.
    Soc. Am. A 11, 766 (1994)), which of a 2 × 2 matrix is J + (d/|d|)·adj(J)†, d its determinant,
    but for a real factor.

    Args:
        jones: (..., 2, 2), of an axis that geometry does not turn.

    Returns:
        Both (...); the retardance from 0 to 180, the axis of the linear part from -90 to 90.
    """
    (a, b), (c, d) = (row.unbind(-1) for row in jones.unbind(-2))
    determinant = a * d - b * c
    # Half of its phase is that of the mean of both eigenvalues, or opposite to it.
    root = determinant.sqrt()
    phase = root / root.abs().clamp(min=torch.finfo(root.real.dtype).tiny)
    # U without that phase is cos δ/2 - i·sin δ/2 · (q₁σ₁ + q₂σ₂ + q₃σ₃).
    a, b, c, d = (v * phase.conj() for v in (a, b, c, d))
    mean = (a + d).real
    # U₁₁ = J₁₁ + J₂₂*, U₁₂ = J₁₂ - J₂₁*, and so on.
    first, second, third = (d - a).imag, -(b + c).imag, (c - b).real
    size = torch.sqrt(first * first + second * second + third * third)
    sign = torch.where(mean < 0.0, -1.0, 1.0)
    angle = 2.0 * torch.atan2(size, mean.abs())
    # first > 0 where light along x is earlier.
    axis = 0.5 * torch.atan2(sign * second, sign * first)
    return torch.rad2deg(angle), torch.rad2deg(axis)


def mueller(jones: Tensor) -> Tensor:
    """Return the Mueller matrices (..., 4, 4), real, of Jones matrices (..., 2, 2)."""
    sigma = _PAULI.to(jones)
    # S_i = tr(σ_i·C) of the coherency matrix C = E·E†, and C = ½·Σ S_j·σ_j.
    return 0.5 * torch.einsum("iab,...bc,jcd,...ad->...ij", sigma, jones, sigma, jones.conj()).real
