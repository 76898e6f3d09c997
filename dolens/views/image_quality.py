"""Image quality of a lens: spots, fans, MTF, PSF and wavefronts at field points, and curves over
the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.views.overview import as_lens, looked_at, shown, title_of, traced_at_once

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.fields_and_wavelengths import FieldPoints
    from dolens.views.overview import Wavelengths

KINDS = ("fourier", "huygens")
# Of a draft: rays of each spot, in a spot diagram and for the MTF of rays.
_DRAFT_SPOT, _DRAFT_MTF = 1000, 2000


class ImageQualityViews:
    """Methods of `Lens` that show its image and its wavefronts; see `LensViews` for their
    arguments."""

    # ---------------------------------------------------------------- at field points

    def spots(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        rays: int = 2000,
        overlaid: bool = True,
        draft: bool = False,
        **aperture: float,
    ) -> Figure:
        """Plot spot diagrams; the numbers are those of `analysis.spot_diagram.spot_diagram`.

        A draft has 1000 rays a spot at most, and a small lens is traced without kernels: the first
        call waits for none to be loaded or compiled.  Over the lenses of conf/lens RMS radii of all
        wavelengths were off by 0.5 % or less, and by 1 to 3 % at fields that lose much of their
        light to other apertures than the stop; those of one wavelength there by up to 8 %.

        Example:
            >>> import dolens
            >>> figure = dolens.load_lens("cooke_triplet").spots(draft=True)
            >>> figure.draft, figure.get_suptitle().split(":")[0]
            (True, 'Spot diagram (draft)')

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            rays: of each spot, a multiple of four.
            overlaid: one panel a field; else one for every field and wavelength.
            draft: see above; the figure's title and its attribute `draft` say so.
            aperture: see the class.
        """
        from dolens.analysis.spot_diagram import spot_diagram
        from dolens.plotting.spots_and_ray_fans import spots_figure

        lens, given = looked_at(self.spots, fields, wavelengths, object_distance, aperture)
        if draft:
            lens, rays = traced_at_once(lens, given), min(rays, _DRAFT_SPOT)
        spots = spot_diagram(lens, given, rays)
        title = title_of("Spot diagram", lens, given, draft)
        return shown(spots_figure(spots, overlaid, title), draft)

    def ray_fans(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot transverse ray aberrations; see `analysis.ray_intercepts.ray_fans`."""
        from dolens.analysis.ray_intercepts import ray_fans
        from dolens.plotting.spots_and_ray_fans import ray_fans_figure

        lens, given = looked_at(self.ray_fans, fields, wavelengths, object_distance, aperture)
        return shown(ray_fans_figure(ray_fans(lens, given), title_of("Ray fans", lens, given)))

    def mtf(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        frequencies: Sequence[float] | Tensor | None = None,
        diffraction: bool = True,
        geometric: bool = True,
        kind: str = "fourier",
        draft: bool = False,
        **aperture: float,
    ) -> Figure:
        """Plot the MTF with diffraction and of rays, of all wavelengths together.

        A draft leaves out the MTF of rays, unless it is asked for alone, and the second computation
        that knows the sampling error.  Spots of more than some 50 Airy radii have the MTF of 2000
        rays a wavelength.  Small lenses are traced as in a draft of `spots`.  Over the lenses of
        conf/lens contrast was off by 0.05 or less (double Gauss; mostly 0.03) where rays take the
        place of diffraction, and not at all elsewhere.  Over the 98 of conf/lens/published it was
        off by 0.12 or less, but for one by 0.8, whose two panels of the exact figure differ as much
        (`internal_focus_jph04294310_ex1`).

        See `diffraction.modulation_transfer.diffraction_modulation`,
        `diffraction.huygens.huygens_modulation` and
        `analysis.modulation_transfer.modulation`.

        Example:
            >>> import dolens
            >>> figure = dolens.load_lens("cooke_triplet").mtf(draft=True)
            >>> figure.draft, len(figure.get_axes())
            (True, 1)

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            frequencies: cycles/mm; None for 61 as far as the best field leaves contrast.
            diffraction: whether to plot the MTF with diffraction.
            geometric: whether to plot the MTF of rays.
            kind: of the diffraction: `fourier`, or `huygens`, which takes far longer.
            draft: see above; the figure's title and its attribute `draft` say so.
            aperture: see the class.

        Raises:
            InputError: as the class says, or a draft of kind `huygens`.
        """
        check_choice(kind, KINDS, "kind")
        if draft and kind == "huygens":
            raise InputError("draft: True with kind 'huygens'; allowed: drafts of kind 'fourier'")
        from dolens.analysis.modulation_transfer import frequency_range, modulation
        from dolens.analysis.ray_intercepts import aimed_at_stop
        from dolens.diffraction.huygens import huygens_modulation
        from dolens.diffraction.modulation_transfer import diffraction_modulation
        from dolens.plotting.modulation import modulation_comparison_figure

        lens, given = looked_at(self.mtf, fields, wavelengths, object_distance, aperture)
        if draft:
            lens = traced_at_once(lens, given)
        geometric = geometric and not (draft and diffraction)
        aimed = aimed_at_stop(lens, given.that_count()) if geometric else None
        if frequencies is None:
            frequencies = frequency_range(lens, given, aimed=aimed)
        wave = rays = None
        if diffraction and kind == "huygens":
            wave = huygens_modulation(lens, given, frequencies)
        elif diffraction:
            wave = diffraction_modulation(lens, given, frequencies, draft=draft)
        if geometric:
            settings = {"rays": _DRAFT_MTF} if draft else {}
            rays = modulation(lens, given, frequencies, aimed=aimed, **settings)
        title = title_of("Modulation transfer function", lens, given, draft)
        return shown(modulation_comparison_figure(wave, rays, title), draft)

    def encircled_energy(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        radii_um: Sequence[float] | Tensor | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot encircled energy, with diffraction and of rays.

        See `diffraction.point_spread.diffraction_encircled_energy` and
        `analysis.encircled_energy.encircled_energy`.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            radii_um: µm, ascending; None for 101 as far as the largest point spread function goes.
            aperture: see the class.
        """
        from dolens.analysis.encircled_energy import encircled_energy
        from dolens.diffraction.point_spread import diffraction_encircled_energy
        from dolens.plotting.point_spread import encircled_energy_figure

        lens, given = looked_at(
            self.encircled_energy, fields, wavelengths, object_distance, aperture
        )
        waves = diffraction_encircled_energy(lens, given, radii_um)
        rays = encircled_energy(lens, given, waves.radii_um)
        title = title_of("Encircled energy", lens, given)
        return shown(encircled_energy_figure(waves, rays, title))

    def psf(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        kind: str = "fourier",
        **aperture: float,
    ) -> Figure:
        """Show point spread functions with diffraction, of all wavelengths together.

        See `diffraction.point_spread.point_spread` and
        `diffraction.huygens.huygens_point_spread`.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            kind: `fourier`, the transform of the pupil, or rays alone where the wavefront is too
                steep for it; or `huygens`, the sum of wavelets, which takes far longer.
            aperture: see the class.
        """
        check_choice(kind, KINDS, "kind")
        from dolens.diffraction.huygens import huygens_point_spread
        from dolens.diffraction.point_spread import point_spread
        from dolens.plotting.point_spread import point_spread_figure

        lens, given = looked_at(self.psf, fields, wavelengths, object_distance, aperture)
        by_waves = huygens_point_spread if kind == "huygens" else point_spread
        found = by_waves(lens, given)
        return shown(point_spread_figure(found, title_of("Point spread functions", lens, given)))

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
        maps = wavefront_maps(lens, given)
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
        maps = wavefront_maps(lens, given)
        title = title_of("Zernike coefficients", lens, given)
        return shown(zernike_figure(maps, order, terms, title))

    # ---------------------------------------------------------------- over the field

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
        curves = [
            field_curves(lens, scan, given.wavelengths, distortion)
            for scan in field_scans(lens, given.object_distance, edge)
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
        colour = [lateral_colour(lens, scan, waves) for scan in field_scans(lens, distance, edge)]
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

        See `analysis.spot_diagram`.

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
        far = field_scans(lens, given.object_distance, edge)[0].fields[-1]
        over_field = rms_against_field(lens, given, far)
        over_wave = rms_against_wavelength(lens, given, wavelength_interval(lens))
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
        curves = [
            relative_illumination(lens, scan, wavelength)
            for scan in field_scans(lens, given.object_distance, edge)
        ]
        title = title_of("Relative illumination", lens, given)
        return shown(illumination_figure(curves, title))

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
        scans = [
            (scan, strehl_ratios(lens, given.at(scan.fields)))
            for scan in field_scans(lens, given.object_distance, edge, count)
        ]
        return shown(strehl_figure(scans, title_of("Strehl ratio", lens, given)))
