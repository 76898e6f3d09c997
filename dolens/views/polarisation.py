"""A lens shows what it does to polarised light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dolens.views.overview import as_lens, looked_at, shown, title_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.fields_and_wavelengths import FieldPoints

_CROSSED: tuple[tuple[Mapping[str, Any], ...], ...] = (({"polariser": 0},), ({"polariser": 90},))


class PolarisationViews:
    """Methods of `Lens` that show polarisation; see `LensViews` for their arguments."""

    def polarisation(
        self,
        fields: FieldPoints | None = None,
        wavelength: float | None = None,
        object_distance: float | None = None,
        front: Sequence[Mapping[str, Any]] | None = None,
        behind: Sequence[Mapping[str, Any]] | None = None,
        **aperture: float,
    ) -> Figure:
        """Show transmission, diattenuation and retardance over the stop, and the light behind ideal
        elements: of crossed polarisers, unless others are given.

        Surfaces without a coating are ideal, and change no polarisation; `lens.coated("none")`
        has bare glass.  See `diffraction.jones_pupils` for the numbers, and for the axes.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelength: nm; None for the reference wavelength.
            object_distance: see the class.
            front: ideal elements in front: `[{"polariser": 0}]`, or
                `[{"polariser": 0}, {"retarder": 45, "retardance": 90}]`, degrees.
            behind: ideal elements behind.
            aperture: see the class.
        """
        from dolens.diffraction.jones_pupils import jones_pupils
        from dolens.plotting.jones_pupils import jones_pupils_figure

        wavelength = wavelength or as_lens(self).primary_wavelength
        lens, given = looked_at(self.polarisation, fields, wavelength, object_distance, aperture)
        crossed = front is None and behind is None
        chosen = _CROSSED if crossed else (front or (), behind or ())
        own = jones_pupils(lens, given)
        between = own.between(*chosen)
        name = "crossed polarisers" if crossed else "with the elements"
        title = title_of("Polarisation", lens, given)
        return shown(jones_pupils_figure(own, between, name, title))
