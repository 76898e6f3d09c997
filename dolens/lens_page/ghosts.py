"""The ghosts of a lens at its fields, for its page and for a terminal."""

from collections.abc import Sequence

from dolens.analysis.conditions import Conditions
from dolens.analysis.ghosts import ghosts
from dolens.lens_page.tables import Table
from dolens.optics.lens import Lens
from dolens.views.ghosts import HEADINGS, NOTE, LensGhosts

# Rows of a table.
_MOST = 8


def ghosts_of_fields(lens: Lens, where: Conditions) -> list[LensGhosts]:
    """Return the ghosts of a source at each field, at the reference wavelength.

    Raises:
        InputError: fewer than two surfaces reflect light, or none of a field enters.
    """
    at = [where.at(field[None], where.reference_wavelength) for field in where.fields]
    return [LensGhosts(lens, ghosts(lens, one)) for one in at]


def ghost_tables(found: Sequence[LensGhosts]) -> list[Table]:
    """Return a table of the brightest ghosts of each field; the last says what numbers mean."""
    tables = []
    for one in found:
        rows = one.rows(_MOST)
        caption = f"{one.heading}.  {one.rest(len(rows))}"
        if one is found[-1]:
            caption += NOTE
        tables.append(Table(HEADINGS, rows, caption.strip(), frozenset({0, len(HEADINGS) - 1})))
    return tables
