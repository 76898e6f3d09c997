"""The results of a search are written to a folder: files, pictures and a page."""

import logging
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from dolens.analysis.conditions import conditions
from dolens.errors import InputError
from dolens.lens_page.tables import number
from dolens.lens_search.form_report import FormReport
from dolens.lens_search.page import Pictures, forms_page
from dolens.plotting.forms import FormPicture, forms_figure
from dolens.whole_files import written_whole

logger = logging.getLogger(__name__)


def write_page(
    reports: Sequence[FormReport],
    folder: str | Path,
    title: str,
    facts: Sequence[tuple[str, str]],
    pictures: Pictures,
    found: int,
    merit_label: str = "merit",
) -> None:
    """Write `forms.html`; it links to the reports' files, wherever they lie.

    Args:
        reports: of the forms, the best first.
        folder: that the page goes to.
        title: of the page.
        facts: what and how much, for its heading.
        pictures: of the search.
        found: how many forms there are in all.
        merit_label: of the merit, with its unit.

    Raises:
        InputError: the page cannot be written.
    """
    folder = Path(folder)
    page = forms_page(reports, title, facts, pictures, found, folder, merit_label)
    try:
        with written_whole(folder / "forms.html") as aside:
            aside.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None


def sections_figure(reports: Sequence[FormReport], title: str | None = None) -> Figure | None:
    """Draw the sections of all forms that can be drawn; None where there is none.

    Args:
        reports: of the forms, in their order.
        title: above all.
    """
    drawn = [
        FormPicture(
            report.section,
            str(report.number),
            f"{number(report.found.mean_rms_spot_um, 3, zeros=True)} µm    {report.powers}",
            report.broken,
        )
        for report in reports
        if report.section is not None
    ]
    if not drawn:
        return None
    return forms_figure(drawn, title=title, field_unit=conditions(reports[0].lens).field_unit)
