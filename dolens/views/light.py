"""A lens shows what it does to light: which share passes, and how it is polarised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from dolens.views.overview import as_lens, looked_at, shown, title_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.fields_and_wavelengths import FieldPoints
    from dolens.analysis.transmission import Transmission
    from dolens.diffraction.gaussian_beams import FibreCoupling, GaussianBeam
    from dolens.optics.lens import Lens
    from dolens.views.overview import Wavelengths

_CROSSED: tuple[tuple[Mapping[str, Any], ...], ...] = (({"polariser": 0},), ({"polariser": 90},))


class LightViews:
    """Methods of `Lens` about its coatings and what they do to light; see `LensViews` for their
    arguments."""

    def coated(self, coating: Any) -> Lens:
        """Return a copy of this lens with coatings, as a prescription writes them.

        Example:
            >>> import dolens
            >>> lens = dolens.load_lens("cooke_triplet")
            >>> print(lens.coated({1: "none", 2: "quarter_wave"}).prescription().notes[1])
            coating of surface 2: INFRARED:MGF2 99.7 nm

        Args:
            coating: `ideal`, `none`, `quarter_wave`, layers or a table, for all surfaces between
                air and glass, cemented ones being bare; or surface number → coating, for these
                alone.  See `dolens.prescriptions.coatings`.

        Raises:
            InputError: one line that names the surface, the key, and what is allowed.
        """
        from dolens.prescriptions.coatings import coated

        return coated(as_lens(self), coating)

    def crystal_rays(self) -> dict[str, Lens]:
        """Return a copy of this lens for every choice of ordinary and extraordinary rays in its
        crystals, in the order of the light: `oe` is ordinary in the first and extraordinary in the
        second.

        Light that is split goes by all of them.  Of unpolarised light each image has a share; see
        `trace_polarised` and [polarised light](polarisation.md).

        Raises:
            InputError: there is no crystal, or there are more than eight.
        """
        from dolens.optics.crystals import lenses_of_rays

        return lenses_of_rays(as_lens(self))

    def transmission(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Transmission:
        """Return which share of the light arrives, by field, wavelength and surface; it shows
        itself as text or HTML, and `figure()` plots it.

        Surfaces without a coating are ideal, and lose nothing; see `coated`.  The numbers have no
        gradients; those of `analysis.transmission.transmission` have.

        Example:
            >>> import dolens
            >>> bare = dolens.load_lens("cooke_triplet").coated("none")
            >>> coated = bare.coated("quarter_wave")
            >>> [round(float(x.transmission(0.0, 550).share), 3) for x in (bare, coated)]
            [0.706, 0.963]

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.analysis.transmission import transmission

        lens, given = looked_at(self.transmission, fields, wavelengths, object_distance, aperture)
        with torch.no_grad():
            return transmission(lens, given)

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

    def gaussian_beam(
        self,
        waist: float,
        waist_z: float = 0.0,
        wavelength: float | None = None,
        m_squared: float = 1.0,
        meridian: str | None = None,
    ) -> GaussianBeam:
        """Return a Gaussian beam's radius and waist at every surface, by first-order optics; it
        shows itself as text.

        Example:
            >>> import dolens
            >>> beam = dolens.load_lens("cooke_triplet").gaussian_beam(1.0, wavelength=587.5618)
            >>> sensor = beam.rows[-1]
            >>> round(1000.0 * sensor.radius, 1), round(sensor.half_angle, 2)  # µm, degrees
            (10.4, 1.15)

        Args:
            waist: radius at 1/e² of the irradiance, of the waist in front of the lens, mm.
            waist_z: of the waist, mm from the first vertex.
            wavelength: nm; None: the reference wavelength.
            m_squared: how many times wider than the diffraction limit the far field is.
            meridian: `x` or `y`; None: the mean of both sections.
        """
        from dolens.diffraction.gaussian_beams import gaussian_beam

        return gaussian_beam(as_lens(self), waist, waist_z, wavelength, m_squared, meridian)

    def fibre_coupling(
        self,
        source: float,
        fibre: float | None = None,
        position: Sequence[float] | None = None,
        tilt: Sequence[float] | None = None,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> FibreCoupling:
        """Return how much of a fibre's or a laser's light enters a fibre at the sensor; it shows
        itself as text.

        Args:
            source: mode radius of the source fibre, mm, at the object; with the object at infinity
                the radius of a collimated beam.
            fibre: mode radius of the receiving fibre, mm; None: of the same.
            position: of the receiving fibre on the sensor, mm; None: where chief rays land.
            tilt: of it, degrees; None: along the light.
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.diffraction.gaussian_beams import fibre_coupling

        lens, given = looked_at(self.fibre_coupling, fields, wavelengths, object_distance, aperture)
        return fibre_coupling(lens, given, source, fibre, position, tilt)
