"""A lens is shown in space by itself: in a notebook, or as one file that needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from dolens.analysis.conditions import Conditions
from dolens.errors import InputError
from dolens.files import check_written, installed_version
from dolens.html import rendered
from dolens.lens_page.markup import view
from dolens.lens_page.overview import prepared_lens
from dolens.lens_page.solid import Solid, solid
from dolens.views.overview import looked_at

if TYPE_CHECKING:
    from dolens.analysis.fields_and_wavelengths import FieldPoints

_TEMPLATE = Path(__file__).with_name("space.html")
_SUFFIXES = (".html", ".htm")
HANDS = "Drag to turn, pinch or scroll (after a click) to zoom, shift and drag to move."


@dataclass(frozen=True)
class LensInSpace:
    """A view of a lens in space that can be turned; it shows itself in a notebook.

    Attributes:
        name: of the lens.
        solid: surfaces and edges as meshes and rays of the fields, mm, in the lens's axes.
        conditions: the fields, and the wavelength of the rays.
    """

    name: str
    solid: Solid
    conditions: Conditions

    @cached_property
    def html(self) -> str:
        """Return the view as a page: one that needs no network."""
        return rendered(
            _TEMPLATE,
            title=self.name or "Lens",
            space=view(self.solid, self.conditions),
            note=f"{HANDS} Rays at {self.conditions.reference_wavelength:g} nm.",
            version=installed_version("dolens") or "",
        )

    def save(self, path: str | Path) -> Path:
        """Write the page to a file; missing folders are created, and a file there is replaced.

        Args:
            path: ends in `.html`.

        Raises:
            InputError: another ending, or a file that cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in _SUFFIXES:
            raise InputError(
                f"path: '{path}'; allowed: the name of a page, {' or '.join(_SUFFIXES)}"
            )
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            check_written(path, "path")
            path.write_text(self.html, encoding="utf-8")
        except OSError as error:
            raise InputError(f"path: {path}: cannot be written ({error.strerror})") from None
        return path

    def __repr__(self) -> str:
        """Return one line: a page is no text for a terminal."""
        passing = sum(map(bool, self.solid.rays))
        return (
            f"<{self.name or 'Lens'} in space, {passing} of {len(self.solid.rays)} fields with "
            "rays; shows itself in a notebook, and save('lens.html') writes it>"
        )

    def _repr_html_(self) -> str:
        """Return the page in a frame, whose names and styles stay its own."""
        return (
            f'<iframe title="{escape(self.name or "Lens")} in space" sandbox="allow-scripts" '
            'style="width:100%;height:34rem;border:0" '
            f'srcdoc="{escape(self.html)}"></iframe>'
        )


class SpaceViews:
    """Methods of `Lens` that show it in space."""

    def draw_3d(
        self,
        fields: FieldPoints | None = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> LensInSpace:
        """Show the lens in space, as the page of `dolens show` does: one can turn it, zoom, cut it
        in half, and choose the fields whose rays are drawn.

        Example:
            >>> import dolens
            >>> found = dolens.load_lens("cooke_triplet").draw_3d()
            >>> found
            <Cooke triplet in space, 3 of 3 fields with rays; shows itself in a notebook, and
            save('lens.html') writes it>
            >>> sum(mesh.kind == "glass" for mesh in found.solid.meshes)
            6

        Args:
            fields: numbers along y or points (x, y): degrees for an object at infinity, mm on the
                object for a near one; None: the lens's own.
            object_distance: mm in front of the first vertex, `inf` for infinity; None: the lens's
                own.
            aperture: f_number, EFL over the diameter of the entrance pupil, of a copy of the lens
                whose stop is set to it; or entrance_pupil_diameter, mm.

        Returns:
            The view; it shows itself in a notebook, and `.save("lens.html")` writes one file that
            needs no network.  Rays are those of the reference wavelength.

        Raises:
            InputError: a value that cannot be used.  A field that no light reaches has no rays.
        """
        lens, given = looked_at(self.draw_3d, fields, None, object_distance, aperture)
        return LensInSpace(lens.name, solid(prepared_lens(lens), given), given)
