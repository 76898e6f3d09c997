"""Captions say which lens, aperture, wavelengths and object a figure is of."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order

# Longer names of lenses are cut; lines of a caption fit over a narrow figure.
_LONGEST, _LINE = 50, 52


@torch.no_grad()
def caption(
    what: str,
    lens: Lens,
    wavelengths: Sequence[float] | Tensor,
    object_distance: float | None = None,
) -> str:
    """Return a title such as `Spot diagram: Cooke triplet, F/4.93, 587.6 nm`; lines break where
    one is too long for a narrow figure.

    Args:
        what: the figure shows.
        lens: the lens; its F-number is the paraxial one of its stop at the reference wavelength, in
            the y-z section.
        wavelengths: nm.
        object_distance: mm; given, the working F-number and the distance are named.
    """
    first = first_order(lens.system().section("y"), lens.primary_wavelength, object_distance)
    number = abs(float(first.working_f_number))
    parts = []
    if math.isfinite(number):
        working = "" if object_distance is None else "working "
        parts.append(f"{working}F/{number:.3g}")
    parts.append(wavelengths_text(wavelengths))
    if object_distance is not None:
        parts.append(f"object at {object_distance:g} mm")
    name = [f"{plain_text(lens.name)},"] if lens.name else []
    lines = [f"{what}:"]
    for piece in (*name, ", ".join(parts)):
        longer = f"{lines[-1]} {piece}"
        lines[-1:] = [longer] if len(longer) <= _LINE else [lines[-1], piece]
    return "\n".join(lines)


def wavelengths_text(wavelengths: Sequence[float] | Tensor) -> str:
    """Return `587.6 nm`, or the range of several wavelengths and their number."""
    waves = sorted({float(wave) for wave in wavelengths})
    if len(waves) == 1:
        return f"{waves[0]:.4g} nm"
    if len(waves) <= 3:
        return f"{', '.join(f'{wave:.4g}' for wave in waves)} nm"
    return f"{len(waves)} wavelengths from {waves[0]:.4g} to {waves[-1]:.4g} nm"


def plain_text(text: str) -> str:
    """Return text that a figure shows as it is, without formulas, on one line, cut when long."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    text = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
    return text.replace("$", r"\$")
