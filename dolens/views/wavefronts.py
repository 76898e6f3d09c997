"""Wavefronts of a lens and their quality, and where its beams meet the surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dolens.views.overview import as_lens, looked_at, shown, title_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import FieldPoints
    from dolens.views.overview import Wavelengths


class WavefrontViews:
    """Methods of `Lens` about wavefronts and footprints; see `LensViews` for their arguments."""

    def wavefront(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Show the wavefront error of every field over the stop.

        See `diffraction.wavefront_map.wavefront_maps`, also for its sign.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: None for the reference wavelength.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.diffraction.wavefront_map import wavefront_maps
        from dolens.plotting.wavefront_maps import wavefront_maps_figure

        waves = as_lens(self).primary_wavelength if wavelengths is None else wavelengths
        lens, given = looked_at(self.wavefront, fields, waves, object_distance, aperture)
        maps = wavefront_maps(lens, given.fields, given.wavelengths, given.object_distance)
        return shown(wavefront_maps_figure(maps, title_of("Wavefront error", lens, given)))

    def zernike(
        self,
        fields: FieldPoints | None = None,
        wavelength: float | None = None,
        object_distance: float | None = None,
        order: str = "fringe",
        terms: int = 16,
        **aperture: float,
    ) -> Figure:
        """Plot Zernike coefficients of the wavefront error of every field.

        See `diffraction.wavefront_map.WavefrontMaps.zernike` for the numbers.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelength: nm; None for the reference wavelength.
            object_distance: see the class.
            order: `fringe`, or `standard` (Noll's).
            terms: how many to show.
            aperture: see the class.
        """
        from dolens.diffraction.wavefront_map import wavefront_maps
        from dolens.plotting.wavefront_maps import zernike_figure

        wavelength = wavelength or as_lens(self).primary_wavelength
        lens, given = looked_at(self.zernike, fields, wavelength, object_distance, aperture)
        maps = wavefront_maps(lens, given.fields, given.wavelengths, given.object_distance)
        title = title_of("Zernike coefficients", lens, given)
        return shown(zernike_figure(maps, order, terms, title))

    def strehl(
        self,
        edge: float | Sequence[float] | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        count: int = 7,
        **aperture: float,
    ) -> Figure:
        """Plot Strehl ratios over the field; see `diffraction.point_spread.strehl_ratios`.

        Args:
            edge: of the field, as in `field_curves`.
            wavelengths: None for the reference wavelength.
            object_distance: see the class.
            count: field points from the axis to the edge.
            aperture: see the class.
        """
        from dolens.analysis.conditions import field_scans
        from dolens.diffraction.point_spread import strehl_ratios
        from dolens.plotting.wavefront_maps import strehl_figure

        waves = as_lens(self).primary_wavelength if wavelengths is None else wavelengths
        lens, given = looked_at(self.strehl, 0.0, waves, object_distance, aperture)
        distance = given.object_distance
        scans = [
            (scan, strehl_ratios(lens, scan, given.wavelengths, distance))
            for scan in field_scans(lens, distance, edge, count)
        ]
        return shown(strehl_figure(scans, title_of("Strehl ratio", lens, given)))

    def footprint(
        self,
        fields: FieldPoints | None = None,
        wavelength: float | None = None,
        object_distance: float | None = None,
        rays: int = 1000,
        **aperture: float,
    ) -> Figure:
        """Draw where the rays of the fields meet every surface; see `analysis.footprint.footprint`.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelength: nm; None for the reference wavelength.
            object_distance: see the class.
            rays: of each field, a multiple of four.
            aperture: see the class.
        """
        from dolens.analysis.footprint import footprint
        from dolens.plotting.footprint import footprint_figure

        wavelength = wavelength or as_lens(self).primary_wavelength
        lens, given = looked_at(self.footprint, fields, wavelength, object_distance, aperture)
        found = footprint(lens, given.fields, wavelength, rays, given.object_distance)
        return shown(footprint_figure(found, title_of("Footprints", lens, given)))
