"""Starts are laid out in a plane, by what distinguishes those that led to different forms."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError

# A name with a smaller share of a direction is left out of its label.
_LEAST = 0.25
# Parts of a direction that differ by less, as a share, are of one size.
_TIE = 1e-6


@dataclass(frozen=True)
class StartMap:
    """Holds a map of N starts.

    Attributes:
        points: (N, 2).
        labels: of the two coordinates, what they are made of.
        share: of the starts' variance that the plane shows.
    """

    points: Tensor
    labels: tuple[str, str]
    share: float


def start_map(features: Tensor, names: Sequence[str]) -> StartMap:
    """Return the first two principal components of the starts, each with the features it is of.

    Args:
        features: (N, D), without units, as the powers of the elements times the focal length; a
            feature is not scaled, so that one that varies more counts more.
        names: of the D features, as `φ₁`.

    Raises:
        InputError: fewer than two starts or features, or numbers that are not finite.
    """
    if features.ndim != 2 or features.shape[1] != len(names) or min(features.shape) < 2:
        raise InputError(
            f"map of starts: {tuple(features.shape)} numbers and {len(names)} names; allowed: two "
            "starts at least, and two features with a name each"
        )
    if not bool(torch.isfinite(features).all()):
        raise InputError("map of starts: a feature is not finite")
    centred = features.double() - features.double().mean(0)
    _, sizes, directions = torch.linalg.svd(centred, full_matrices=False)
    axes = directions[:2].clone()
    # The first of the largest parts of a direction is positive, whatever the machine.
    large = axes.abs() >= (1.0 - _TIE) * axes.abs().amax(1, keepdim=True)
    axes = axes * axes.gather(1, large.long().argmax(1, keepdim=True)).sign()
    square = sizes.square()
    share = float(square[:2].sum() / square.sum()) if float(square.sum()) > 0.0 else 1.0
    first, second = (_label(axis.tolist(), names) for axis in axes)
    return StartMap(features.double() @ axes.T, (first, second), share)


def _label(axis: Sequence[float], names: Sequence[str]) -> str:
    """Return a direction in words: `0.71 φ₁ − 0.70 φ₂`."""
    text = ""
    for part, name in zip(axis, names, strict=True):
        if abs(part) < _LEAST:
            continue
        sign = " − " if part < 0.0 else " + "
        text += (sign if text else sign.strip().replace("+", "")) + f"{abs(part):.2f} {name}"
    return text
