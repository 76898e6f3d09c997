"""What a lens is: its prescription, its numbers and its section."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dolens.optics.lens_views.conditions import looked_at, shown
from dolens.optics.prescription_table import PrescriptionTable, prescription_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import FieldPoints
    from dolens.analysis.summary import LensSummary
    from dolens.optics.lens_views.conditions import Wavelengths


class OverviewViews:
    """Methods of `Lens` that show what it is; see `LensViews` for their arguments."""

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

        lens, given = looked_at(self.summary, fields, wavelengths, object_distance, aperture)
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

        lens, given = looked_at(self.draw, fields, wavelengths, object_distance, aperture)
        return shown(
            lens_section_figure(
                lens,
                given.fields,
                given.wavelengths,
                given.field_unit,
                given.object_distance,
                rays,
            )
        )
