"""Settings that several experiments have."""

from collections.abc import Sequence
from dataclasses import dataclass

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError
from dolens.experiments.checks import numbers_of
from dolens.optics.dispersion import require_wavelengths
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
        require_wavelengths(wavelengths, "wavelengths")

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
