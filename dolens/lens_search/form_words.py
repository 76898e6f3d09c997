"""A form is said in words: the signs of its elements' powers, its stop, and its glasses."""

from itertools import groupby
from typing import NamedTuple

import torch

from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.paraxial_numbers import ParaxialNumbers

# Elements of less power than this, over the lens's, are neither positive nor negative.
_WEAK = 0.02
_MINUS, _STOP = "−", "|"


class ElementPower(NamedTuple):
    """An `ElementPower` is the power of one element, as if it stood alone in air.

    Attributes:
        first: number of its front surface.
        power: over that of the whole lens.
        glass: its name in a prescription.
    """

    first: int
    power: float
    glass: str


@torch.no_grad()
def element_powers(lens: Lens) -> tuple[ElementPower, ...]:
    """Return the powers of the elements of a centred lens, from the front."""
    system = lens.system().double()
    wave = lens.primary_wavelength
    numbers = ParaxialNumbers.of(system)
    efl = float(lens.first_order(wave).efl)
    found = []
    for k, medium in enumerate(lens.materials[1:-1]):
        if not is_glass(medium):
            continue
        n, thickness = float(medium.index(wave)), numbers.thicknesses[k]
        front, back = numbers.curvatures[k], numbers.curvatures[k + 1]
        power = (n - 1.0) * (front - back + (n - 1.0) / n * thickness * front * back)
        found.append(ElementPower(k + 1, power * efl, medium.name))
    return tuple(found)


def powers_text(lens: Lens) -> str:
    """Return the signs of the powers and the place of the stop: `+ − | (− +) +`.

    Cemented elements stand in parentheses; 0 is an element that hardly has any power.
    """
    words: list[str] = []
    group: list[str] = []
    stopped = False
    for element in element_powers(lens):
        begins = not is_glass(lens.materials[element.first - 1])
        if begins and not stopped and lens.stop <= element.first:
            words.append(_STOP)
            stopped = True
        sign = "0" if abs(element.power) < _WEAK else "+" if element.power > 0.0 else _MINUS
        group.append(sign)
        if not is_glass(lens.materials[element.first + 1]):
            words.append(group[0] if len(group) == 1 else f"({' '.join(group)})")
            group = []
    return " ".join(words if stopped else [*words, _STOP])


def glasses_text(lens: Lens) -> str:
    """Return the glasses from the front: `N-SK16, N-F2, N-SK16`, or `4 × 1.5168`."""
    names = [element.glass for element in element_powers(lens)]
    runs = [(name, len(list(same))) for name, same in groupby(names)]
    return ", ".join(name if count == 1 else f"{count} × {name}" for name, count in runs)
