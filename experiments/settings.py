"""Settings that several experiments have, and checks of numbers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError
from dolens.optics.lens import Lens


@dataclass(frozen=True)
class PupilRays:
    """The rays of a spot: a Gaussian quadrature of the pupil, see `gaussian_quadrature`.

    Attributes:
        rings: number of radii.
        arms: number of azimuths of the whole pupil, even.
    """

    rings: int
    arms: int


@dataclass(frozen=True)
class Spots:
    """The spots of a lens that has no symmetry, one for each field and wavelength.

    Attributes:
        fields: (x, y) each, degrees or mm, on all sides of the axis.
        wavelengths: nm.
        pupil: the rays of each.

    Raises:
        InputError: no field or wavelength, or something else than numbers.
    """

    fields: Sequence[Sequence[float]]
    wavelengths: Sequence[float]
    pupil: PupilRays

    def __post_init__(self) -> None:
        fields = [numbers_of("fields", field, 2) for field in self.fields]
        wavelengths = numbers_of("wavelengths", self.wavelengths)
        for key, given in (("fields", fields), ("wavelengths", wavelengths)):
            if not given:
                raise InputError(f"{key}: none is given")
            object.__setattr__(self, key, given)

    def __len__(self) -> int:
        """Return the number of spots."""
        return len(self.fields) * len(self.wavelengths)

    def rays(self, lens: Lens, pupil: PupilRays | None = None) -> SpotRays:
        """Return the rays through a lens; with a pupil, in its place.

        Raises:
            InputError: a number of rings or arms that there is no quadrature for.
        """
        pupil = pupil or self.pupil
        return gaussian_quadrature(
            lens,
            self.fields,
            self.wavelengths,
            pupil.rings,
            pupil.arms,
            lens.object_distance,
            symmetry=False,
        )


def numbers_of(key: str, values: Any, count: int | None = None) -> list[float]:
    """Return numbers of a configuration as floats.

    Args:
        key: their name in messages.
        values: as they were given.
        count: how many there must be; None: any.

    Raises:
        InputError: something else, or another count.
    """
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        raise InputError(f"{key}: must be numbers, not {values!r}") from None
    if count is not None and len(numbers) != count:
        raise InputError(f"{key}: {count} numbers are needed, not {len(numbers)}")
    return numbers


def check_count(key: str, number: Any) -> None:
    """Refuse what is no integer of 1 or more.

    Raises:
        InputError: it is none.
    """
    if not (type(number) is int and number >= 1):
        raise InputError(f"{key}: {number!r}; allowed: an integer of 1 or more")


def check_positive(key: str, number: Any) -> None:
    """Refuse what is no positive, finite number.

    Raises:
        InputError: it is none.
    """
    if not (isinstance(number, int | float) and 0.0 < number < math.inf):
        raise InputError(f"{key}: {number!r}; allowed: a positive number")
