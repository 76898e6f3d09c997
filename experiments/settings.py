"""Settings that several experiments have, checks of their numbers, and resolvers of OmegaConf.

What shares out the jobs of a sweep reads them too, and waits for no PyTorch: lenses and their rays
are imported where they are used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from dolens.errors import InputError, check_count

if TYPE_CHECKING:
    from dolens.analysis.pupil_quadrature import SpotRays
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
        from dolens.optics.dispersion import require_wavelengths

        fields = [numbers_of("fields", field, 2) for field in self.fields]
        wavelengths = numbers_of("wavelengths", self.wavelengths)
        for key, given in (("fields", fields), ("wavelengths", wavelengths)):
            if not given:
                raise InputError(f"{key}: none is given")
            object.__setattr__(self, key, given)
        require_wavelengths(wavelengths, "wavelengths")

    def __len__(self) -> int:
        """Return the number of spots."""
        return len(self.fields) * len(self.wavelengths)

    def rays(self, lens: "Lens", pupil: PupilRays | None = None) -> "SpotRays":
        """Return the rays through a lens; with a pupil, in its place.

        Raises:
            InputError: a number of rings or arms that there is no quadrature for.
        """
        from dolens.analysis.pupil_quadrature import gaussian_quadrature

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


def check_positive(key: str, number: Any) -> None:
    """Refuse what is no positive, finite number.

    Raises:
        InputError: it is none.
    """
    if not (isinstance(number, int | float) and 0.0 < number < math.inf):
        raise InputError(f"{key}: {number!r}; allowed: a positive number")


def check_not_negative(key: str, number: Any) -> None:
    """Refuse what is no finite number of 0 or more.

    Raises:
        InputError: it is none.
    """
    if not (isinstance(number, int | float) and 0.0 <= number < math.inf):
        raise InputError(f"{key}: {number!r}; allowed: a number of 0 or more")


def check_finite(key: str, number: Any) -> None:
    """Refuse what is no finite number.

    Raises:
        InputError: it is none.
    """
    if isinstance(number, bool) or not (
        isinstance(number, int | float) and -math.inf < number < math.inf
    ):
        raise InputError(f"{key}: {number!r}; allowed: a number")


def check_sensor_distance(lens: "Lens", key: str) -> None:
    """Refuse a lens with the sensor in front of its last surface, where no light comes to.

    Args:
        lens: the lens.
        key: of its prescription.

    Raises:
        InputError: it has one.
    """
    distance = float(lens.sensor_distance.detach())
    if lens.system().senses[-1] * distance < 0.0:
        raise InputError(
            f"{key}.sensor.distance: {distance:g} mm; the sensor must stand behind the last "
            "surface as light travels (negative where it travels towards -z)"
        )


def total_steps(epochs: Any, batches: Any, batches_of_step: Any = 1) -> int:
    """Return the steps of a whole training, each of some batches.

    Args:
        epochs: `trainer.max_epochs`.
        batches: of an epoch, `data.steps_per_epoch`.
        batches_of_step: `trainer.accumulate_grad_batches`.

    Raises:
        InputError: one of them is no number that a schedule could end by.
    """
    check_count("trainer.max_epochs", epochs, 0)
    check_count("data.steps_per_epoch", batches)
    check_count("trainer.accumulate_grad_batches", batches_of_step)
    return epochs * batches // batches_of_step


_RESOLVERS = {
    "total_steps": total_steps,
    # The iterations of all stages together.
    "iterations": lambda stages: sum(stage["iterations"] for stage in stages),
    "count": len,
    "given": bool,
    # The pixels on each side of the middle of a window with an odd number of them.
    "margin_of": lambda size: size // 2,
}


def register_resolvers() -> None:
    """Make the resolvers known to OmegaConf; a second call changes nothing."""
    for name, resolver in _RESOLVERS.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
