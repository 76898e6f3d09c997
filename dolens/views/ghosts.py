"""A lens shows its ghosts: a ranked table, the section of one path, a map of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.optics.text_tables import html_table, measured, printable, text_table
from dolens.views.overview import as_lens, looked_at, shown, title_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.ghosts import Ghosts
    from dolens.optics.lens import Lens
    from dolens.views.overview import Wavelengths

HEADINGS = (
    *("reflected at", "power", "irradiance", "x (mm)", "y (mm)", "RMS radius (mm)"),
    *("focus (mm)", "EFL (mm)", "marginal ray (mm)", "stop's image (mm)", "media"),
)
# Columns of words.
_WORDS = (0, len(HEADINGS) - 1)
NOTE = (
    "Power over that of the image; irradiance, the mean on the ghost, over that of the light in "
    "front of the lens (point source transmittance).  Focus and image of the stop count from the "
    "sensor.  Surfaces without a coating count as bare glass.  ± standard errors."
)
# Rows of a table that shows itself.
_MOST = 20


@dataclass(frozen=True)
class LensGhosts:
    """Ghosts of a lens for one source; they show themselves as a table, the brightest first.

    Attributes:
        lens: the lens.
        found: the numbers; see `dolens.analysis.ghosts.Ghosts`.
        sensor_reflectance: share of the light that the sensor reflects.
    """

    lens: Lens
    found: Ghosts
    sensor_reflectance: float = 0.0

    @property
    def paths(self) -> tuple[tuple[int, ...], ...]:
        """Return the paths, each as the surfaces that reflect, in the order of the light."""
        return self.found.paths

    @property
    def heading(self) -> str:
        """Return whose ghosts they are, of which source, and what they have in common."""
        where, found = self.found.where, self.found
        waves = ", ".join(f"{float(wave):g}" for wave in where.wavelengths)
        field = field_label(where.fields[0], where.field_unit)
        name = printable(self.lens.name) or "Lens"
        begin = f"{name}: {len(found.paths)} ghosts of a source at {field}, {waves} nm"
        if not found.image > 0.0:
            return f"{begin}; no image of it"
        image = measured(100.0 * found.image, 100.0 * found.image_error)
        return (
            f"{begin}; together {100.0 * found.total:.3g} % of the image's power, and that is "
            f"{image} % of the light that enters"
        )

    def rows(self, most: int | None = None) -> list[tuple[str, ...]]:
        """Return the cells of the brightest ghosts below `HEADINGS`; those without light are left
        out.

        Args:
            most: rows; None: all that have light.
        """
        values, errors, first = self.found.measures, self.found.errors, self.found.first_order
        found: list[tuple[str, ...]] = []
        for number, path in enumerate(self.found.paths):
            if not float(values.share[number]) > 0.0 or len(found) == most:
                break
            both = (values.power, errors.power), (values.irradiance, errors.irradiance)
            lengths = tuple(zip(values[3:], errors[3:], strict=True))
            cells = [measured(float(v[number]), float(e[number])) for v, e in (*both, *lengths)]
            axial = (first.focus, first.efl, first.marginal, first.pupil)
            found.append(
                (
                    " → ".join(map(str, path)),
                    *cells,
                    *(f"{float(v[number]):.4g}".replace("inf", "∞") for v in axial),
                    ", ".join(self._media(surface) for surface in path),
                )
            )
        return found

    def _media(self, number: int) -> str:
        """Return the media on both sides of a surface."""
        materials = self.lens.materials
        if number == len(materials):
            return "sensor"
        return f"{materials[number - 1].name}|{materials[number].name}"

    def rest(self, rows: int) -> str:
        """Return what a table with so many rows leaves out."""
        lit = int((self.found.measures.share > 0.0).sum())
        dark = len(self.found.paths) - lit
        parts = [f"{lit - rows} fainter"] * (lit > rows) + [f"{dark} without light"] * (dark > 0)
        return f"Not shown: {', '.join(parts)}.  " if parts else ""

    def __repr__(self) -> str:
        """Return the table as text."""
        rows = self.rows(_MOST)
        table = text_table(HEADINGS, rows, _WORDS)
        return f"{self.heading}\n{table}\n{self.rest(len(rows))}{NOTE}"

    def _repr_html_(self) -> str:
        """Return the table as HTML, all text escaped."""
        rows = self.rows(_MOST)
        return html_table(HEADINGS, rows, self.heading, _WORDS, self.rest(len(rows)) + NOTE)

    def draw(self, path: Sequence[int] | None = None, rays: int = 9) -> Figure:
        """Draw the section of the lens with the rays of one path in the y-z plane.

        Args:
            path: surfaces that reflect, as `(6, 1)`; None: the brightest ghost.
            rays: from the lowest to the highest that arrives.

        Raises:
            InputError: there is no such path.
        """
        from dolens.plotting.ghosts import ghost_section_figure

        chosen = self.paths[0] if path is None else tuple(path)
        title = title_of(f"Ghost {' → '.join(map(str, chosen))}", self.lens, self.found.where)
        return shown(ghost_section_figure(self.lens, chosen, self.found.where, rays, title))

    def map(
        self,
        paths: Sequence[Sequence[int]] | None = None,
        rays: int = 50_000,
        pixels: int = 64,
        width: float | None = None,
    ) -> Figure:
        """Show the irradiance of the ghosts over the sensor; see `analysis.ghost_map.ghost_map`.

        Args:
            paths: those that count, as `[(6, 1)]`; None: those of the table.
            rays: of each path and wavelength.
            pixels: along each side.
            width: mm, of the square; None: the sensor's diameter, or all that is lit.
        """
        from dolens.analysis.ghost_map import ghost_map
        from dolens.plotting.ghosts import ghost_map_figure

        where = self.found.where
        found = ghost_map(
            self.lens,
            where,
            rays,
            pixels,
            width,
            sensor_reflectance=self.sensor_reflectance,
            paths=self.paths if paths is None else paths,
        )
        return shown(ghost_map_figure([found], title_of("Ghosts", self.lens, where)))


class GhostViews:
    """The method of `Lens` that shows its ghosts."""

    def ghosts(
        self,
        field: float | Sequence[float] = 0.0,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        bounces: int = 2,
        sensor_reflectance: float = 0.0,
        rays: int = 10_000,
        **aperture: float,
    ) -> LensGhosts:
        """Return the ghosts of a source: all paths of light that is reflected twice.

        See `analysis.ghosts` for the numbers.  Light that lands beside the sensor, where the lens
        names its diameter, does not count.

        Example:
            >>> import dolens
            >>> ghosts = dolens.load_lens("cooke_triplet").ghosts(field=10)
            >>> len(ghosts.paths), ghosts.paths[0]
            (15, (6, 1))

        Args:
            field: of the source, inside of the lens's field or not: a number along y, or (x, y).
            wavelengths: nm; None for the reference wavelength.
            object_distance: mm in front of the first vertex, `inf` for infinity.
            bounces: reflections of a path: 2, 4 or 6.
            sensor_reflectance: share of the light that the sensor reflects, as a mirror.
            rays: of each path and wavelength, before the front surface takes some.
            aperture: see the class.

        Raises:
            InputError: as the class says, or fewer than two surfaces reflect light.
        """
        from dolens.analysis.ghosts import ghosts

        waves = as_lens(self).primary_wavelength if wavelengths is None else wavelengths
        if not isinstance(field, int | float) and len(field) != 2:
            raise InputError(f"field: {field!r}; allowed: a number along y, or (x, y)")
        points = field if isinstance(field, int | float) else [tuple(field)]
        lens, given = looked_at(self.ghosts, points, waves, object_distance, aperture)
        found = ghosts(lens, given, rays, bounces, sensor_reflectance)
        return LensGhosts(lens, found, sensor_reflectance)
