"""What a lens shows of itself, in a notebook above all.

The methods stand on the floors above: analysis, diffraction, plotting.  They are imported when a
method is called, so that a lens can be traced and trained without them.  Every method takes the
lens's own fields, wavelengths and object distance unless others are given (see
`dolens.analysis.conditions` for the defaults of a lens that names none), and returns a figure that
belongs to nobody else: pyplot does not know it.

The numbers behind each figure come from the functions that the methods call.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from dolens.optics.prescription_table import PrescriptionTable, prescription_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import Conditions, FieldPoints
    from dolens.analysis.summary import LensSummary
    from dolens.optics.lens import Lens

    Wavelengths = float | Sequence[float] | Tensor | None


class LensViews:
    """Methods of `Lens` that show it.

    Arguments that all of them share:

        fields: numbers along y or points (x, y): degrees for an object at infinity, mm on the
            object for a near one.
        wavelengths: nm.
        object_distance: mm in front of the first vertex, `inf` for infinity.
        f_number: EFL over the diameter of the entrance pupil, of a copy of the lens whose stop is
            set to it; or
        entrance_pupil_diameter: mm.

    They raise `InputError` where a value cannot be used; a field that no light reaches is shown as
    such.
    """

    def __repr__(self) -> str:
        """Return the prescription as a table."""
        return self.prescription().text()

    def _repr_html_(self) -> str:
        """Return the prescription as a table for a notebook; all text is escaped."""
        return self.prescription().html()

    def prescription(self) -> PrescriptionTable:
        """Return the prescription in the lens's present state as plain values."""
        return prescription_table(self)

    def summary(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> LensSummary:
        """Return first-order data, Seidel sums and spot radii; it shows itself as text or HTML."""
        from dolens.analysis.summary import lens_summary

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        distance = float("inf") if given.object_distance is None else given.object_distance
        return lens_summary(lens, given.fields, given.wavelengths, distance)

    def draw(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        rays: int = 7,
        **aperture: float,
    ) -> Figure:
        """Draw the section in the y-z plane with the rays of the fields in that plane.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: rays of the reference or nearest one are drawn.
            object_distance: see the class.
            rays: of each field.
            aperture: see the class.
        """
        from dolens.plotting.lens_section import lens_section_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        return _shown(
            lens_section_figure(
                lens,
                given.fields,
                given.wavelengths,
                given.field_unit,
                given.object_distance,
                rays,
            )
        )

    def spots(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        rays: int = 2000,
        overlaid: bool = True,
        **aperture: float,
    ) -> Figure:
        """Plot spot diagrams; the numbers are those of `analysis.spot_diagram.spot_diagram`.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            rays: of each spot, a multiple of four.
            overlaid: one panel a field; else one for every field and wavelength.
            aperture: see the class.
        """
        from dolens.analysis.spot_diagram import spot_diagram
        from dolens.plotting.spots import spots_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        spots = spot_diagram(lens, given.fields, given.wavelengths, rays, given.object_distance)
        return _shown(spots_figure(spots, overlaid, _title("Spot diagram", lens, given)))

    def ray_fans(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot transverse ray aberrations; see `analysis.ray_fans.ray_fans`."""
        from dolens.analysis.ray_fans import ray_fans
        from dolens.plotting.ray_fans import ray_fans_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        fans = ray_fans(
            lens, given.fields, given.wavelengths, object_distance=given.object_distance
        )
        return _shown(ray_fans_figure(fans, _title("Ray fans", lens, given)))

    def mtf(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        frequencies: Sequence[float] | Tensor | None = None,
        diffraction: bool = True,
        geometric: bool = True,
        **aperture: float,
    ) -> Figure:
        """Plot the MTF with diffraction and of rays, of all wavelengths together.

        See `diffraction.transfer.diffraction_modulation` and
        `analysis.modulation_transfer.modulation`.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: see the class.
            object_distance: see the class.
            frequencies: cycles/mm; None for 61 as far as the best field leaves contrast.
            diffraction: whether to plot the MTF with diffraction.
            geometric: whether to plot the MTF of rays.
            aperture: see the class.
        """
        from dolens.analysis.modulation_transfer import frequency_range, modulation
        from dolens.diffraction.transfer import diffraction_modulation
        from dolens.plotting.modulation_comparison import modulation_comparison_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        scene = given.fields, given.wavelengths
        distance = given.object_distance
        if frequencies is None:
            frequencies = frequency_range(lens, *scene, distance)
        wave = diffraction_modulation(lens, *scene, frequencies, distance) if diffraction else None
        rays = modulation(lens, *scene, frequencies, 6000, distance) if geometric else None
        title = _title("Modulation transfer function", lens, given)
        return _shown(modulation_comparison_figure(wave, rays, title))

    def field_curves(
        self,
        edge: float | Sequence[float] | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Plot field curvature and distortion; see `analysis.field_curves.field_curves`.

        Args:
            edge: of the field, degrees or mm, or a point (x, y); None for the farthest of the
                lens's fields.
            wavelengths: see the class, as the other arguments that are not named here.
            object_distance: see the class.
            aperture: see the class.
        """
        from dolens.analysis.conditions import field_scans
        from dolens.analysis.field_curves import field_curves
        from dolens.plotting.field_curves import field_curves_figure

        lens, given = _looked_at(self, 0.0, wavelengths, object_distance, aperture)
        distance = given.object_distance
        curves = [
            field_curves(lens, scan, given.wavelengths, distance)
            for scan in field_scans(lens, distance, edge)
        ]
        return _shown(field_curves_figure(curves, _title("Field curves", lens, given)))

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
        from dolens.plotting.lateral_colour import lateral_colour_figure

        lines = spectral_lines(self) if wavelengths is None else wavelengths
        lens, given = _looked_at(self, 0.0, lines, object_distance, aperture)
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
        title = _title("Chromatic aberrations", lens, given)
        return _shown(lateral_colour_figure(colour, shift, title))

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
        from dolens.analysis.rms_curves import rms_against_field, rms_against_wavelength
        from dolens.plotting.rms_curves import rms_curves_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        distance = given.object_distance
        far = field_scans(lens, distance, edge)[0].fields[-1]
        over_field = rms_against_field(lens, given.wavelengths, far, object_distance=distance)
        over_wave = rms_against_wavelength(
            lens, given.fields, wavelength_interval(lens), object_distance=distance
        )
        title = _title("RMS spot radius", lens, given)
        return _shown(rms_curves_figure(over_field, over_wave, title))

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
        from dolens.plotting.encircled_energy import encircled_energy_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        scene, distance = (given.fields, given.wavelengths), given.object_distance
        waves = diffraction_encircled_energy(lens, *scene, radii_um, distance)
        rays = encircled_energy(lens, *scene, waves.radii_um, object_distance=distance)
        title = _title("Encircled energy", lens, given)
        return _shown(encircled_energy_figure(waves, rays, title))

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
        from dolens.plotting.illumination import illumination_figure

        wavelength = wavelength or self.primary_wavelength
        lens, given = _looked_at(self, 0.0, wavelength, object_distance, aperture)
        distance = given.object_distance
        curves = [
            relative_illumination(lens, scan, wavelength, distance)
            for scan in field_scans(lens, distance, edge)
        ]
        title = _title("Relative illumination", lens, given)
        return _shown(illumination_figure(curves, title))

    def psf(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> Figure:
        """Show point spread functions with diffraction, of all wavelengths together.

        See `diffraction.point_spread.point_spread`.
        """
        from dolens.diffraction.point_spread import point_spread
        from dolens.plotting.point_spread import point_spread_figure

        lens, given = _looked_at(self, fields, wavelengths, object_distance, aperture)
        found = point_spread(lens, given.fields, given.wavelengths, given.object_distance)
        return _shown(point_spread_figure(found, _title("Point spread functions", lens, given)))


def _looked_at(
    lens: Any,
    fields: FieldPoints | None,
    wavelengths: Wavelengths,
    object_distance: float | None,
    aperture: dict[str, float],
) -> tuple[Lens, Conditions]:
    """Return the lens at an aperture, and the conditions that it is looked at."""
    from dolens.analysis.conditions import conditions
    from dolens.errors import check_keys
    from dolens.optics.aperture_setting import with_aperture

    check_keys(aperture, ("f_number", "entrance_pupil_diameter"), "aperture")
    lens = with_aperture(lens, **aperture)
    return lens, conditions(lens, fields, wavelengths, object_distance)


def _title(what: str, lens: Lens, given: Conditions) -> str:
    from dolens.plotting.captions import caption

    return caption(what, lens, given.wavelengths, given.object_distance)


def _shown(figure: Figure) -> Figure:
    """Return a figure that a notebook shows, once, whether pyplot was imported or not."""
    from dolens.plotting.notebook import showing

    return showing(figure)
