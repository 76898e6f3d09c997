"""How the image changes over the field: curvature, colour, spot radii, illumination."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dolens.optics.lens_views.conditions import as_lens, looked_at, shown, title_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import FieldPoints
    from dolens.optics.lens_views.conditions import Wavelengths


class OverFieldViews:
    """Methods of `Lens` that show curves over the field; see `LensViews` for their arguments."""

    def field_curves(
        self,
        edge: float | Sequence[float] | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        distortion: str = "f_tan_theta",
        **aperture: float,
    ) -> Figure:
        """Plot field curvature and distortion; see `analysis.field_curves.field_curves`.

        Args:
            edge: of the field, degrees or mm, or a point (x, y); None for the farthest of the
                lens's fields.
            wavelengths: see the class, as the other arguments that are not named here.
            object_distance: see the class.
            distortion: from `f_tan_theta`, or from `f_theta`, as of a fisheye or a scan lens.
            aperture: see the class.
        """
        from dolens.analysis.conditions import field_scans
        from dolens.analysis.field_curves import field_curves
        from dolens.plotting.field_curves import field_curves_figure

        lens, given = looked_at(self.field_curves, 0.0, wavelengths, object_distance, aperture)
        distance = given.object_distance
        curves = [
            field_curves(lens, scan, given.wavelengths, distance, distortion)
            for scan in field_scans(lens, distance, edge)
        ]
        return shown(field_curves_figure(curves, title_of("Field curves", lens, given)))

    def lateral_colour(
        self,
        edge: float | Sequence[float] | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot lateral colour over the field and the paraxial focus over the wavelength.

        See `analysis.lateral_colour`.

        Args:
            edge: of the field, as in `field_curves`.
            wavelengths: None for the lens's own; for a lens of one wavelength, that and the ends of
                the spectrum about it.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.analysis.conditions import field_scans, spectral_lines
        from dolens.analysis.lateral_colour import chromatic_focal_shift, lateral_colour
        from dolens.plotting.field_curves import lateral_colour_figure

        lines = spectral_lines(as_lens(self)) if wavelengths is None else wavelengths
        lens, given = looked_at(self.lateral_colour, 0.0, lines, object_distance, aperture)
        distance, waves = given.object_distance, given.wavelengths
        colour = [
            lateral_colour(lens, scan, waves, distance)
            for scan in field_scans(lens, distance, edge)
        ]
        low, high = float(waves.min()), float(waves.max())
        shift = (
            chromatic_focal_shift(lens, (low, high), object_distance=distance)
            if low < high
            else None
        )
        title = title_of("Chromatic aberrations", lens, given)
        return shown(lateral_colour_figure(colour, shift, title))

    def rms(
        self,
        edge: float | Sequence[float] | None = None,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot RMS spot radii over the field, and over the wavelength for some fields.

        See `analysis.rms_curves`.

        Args:
            edge: of the field, as in `field_curves`.
            fields: of the curves over the wavelength; see the class.
            wavelengths: of the curves over the field; see the class.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.analysis.conditions import field_scans, wavelength_interval
        from dolens.analysis.spot_diagram import rms_against_field, rms_against_wavelength
        from dolens.plotting.field_curves import rms_curves_figure

        lens, given = looked_at(self.rms, fields, wavelengths, object_distance, aperture)
        distance = given.object_distance
        far = field_scans(lens, distance, edge)[0].fields[-1]
        over_field = rms_against_field(lens, given.wavelengths, far, object_distance=distance)
        over_wave = rms_against_wavelength(
            lens, given.fields, wavelength_interval(lens), object_distance=distance
        )
        title = title_of("RMS spot radius", lens, given)
        return shown(rms_curves_figure(over_field, over_wave, title))

    def relative_illumination(
        self,
        edge: float | Sequence[float] | None = None,
        wavelength: float | None = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot how bright a uniform scene is over the field; see `diffraction.illumination`.

        Args:
            edge: of the field, as in `field_curves`.
            wavelength: nm; None for the reference wavelength.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.analysis.conditions import field_scans
        from dolens.diffraction.illumination import relative_illumination
        from dolens.plotting.field_curves import illumination_figure

        wavelength = wavelength or as_lens(self).primary_wavelength
        lens, given = looked_at(
            self.relative_illumination, 0.0, wavelength, object_distance, aperture
        )
        distance = given.object_distance
        curves = [
            relative_illumination(lens, scan, wavelength, distance)
            for scan in field_scans(lens, distance, edge)
        ]
        title = title_of("Relative illumination", lens, given)
        return shown(illumination_figure(curves, title))
