"""The results of a search are written to a folder: files, pictures and a page."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from torch import Tensor

from dolens.analysis.conditions import conditions
from dolens.errors import InputError
from dolens.lens_page.tables import number
from dolens.lens_search.course import SearchCourse
from dolens.lens_search.form_report import FormReport, report_form
from dolens.lens_search.forms import Form
from dolens.lens_search.page import Pictures, forms_page
from dolens.lens_search.requirements import Requirements
from dolens.lens_search.start_map import StartMap
from dolens.plotting.export import save_figure
from dolens.plotting.forms import FormPicture, forms_figure
from dolens.plotting.search_course import search_course_figure
from dolens.plotting.starts import starts_figure
from dolens.whole_files import written_whole

logger = logging.getLogger(__name__)

# Forms that are reported, the best first.
MOST = 24
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Starts:
    """Says which start led where.

    Attributes:
        map: of N starts.
        forms: (N,), number of the form that each reached, from 0, the best; -1 for none.
        tried: all starts, of which the map may show some.
    """

    map: StartMap
    forms: Tensor
    tried: int

    def figure(self) -> Figure:
        """Draw the map, and how many starts each form has."""
        share = f"{100.0 * self.map.share:.0f} % of the starts' variance"
        return starts_figure(
            self.map.points.numpy(),
            self.forms.tolist(),
            self.map.labels,
            self.tried,
            f"Which start led where ({share})",
        )


def course_figure(course: SearchCourse, merit_label: str = "merit") -> Figure:
    """Draw the course of a search; the label of the merit has its unit."""
    return search_course_figure(
        course.seconds,
        course.merits,
        course.best,
        course.forms,
        merit_label,
        course.within,
        "Course of the search",
    )


def write_results(
    forms: Sequence[Form],
    folder: str | Path,
    required: Requirements,
    title: str,
    facts: Sequence[tuple[str, str]] = (),
    starts: Starts | None = None,
    course: SearchCourse | None = None,
    merit_label: str = "merit",
    most: int = MOST,
    progress: Progress | None = None,
) -> tuple[FormReport, ...]:
    """Write `forms.html`, `forms.png`, `starts.png`, `merit_over_time.png`, and each form's files.

    Args:
        forms: as `distinct` returns them, the best first.
        folder: it is made.
        required: what the lenses must keep.
        title: of the page, as `Monochromatic quartet`.
        facts: what and how much, for the page's heading.
        starts: which start led where; None leaves the picture out.
        course: of the search; None leaves the picture out.
        merit_label: of the merit, with its unit.
        most: forms that are reported.

    Rarely needed:
        progress: is called with a form's name, the forms done and the number of all.

    Returns:
        What was found out about each form, in their order.

    Raises:
        InputError: there are no forms, or a file cannot be written.
    """
    if not forms:
        raise InputError("results: the search found no lens")
    folder = Path(folder)
    said = progress or (lambda name, done, total: None)
    reports = []
    chosen = list(forms)[:most]
    for rank, form in enumerate(chosen, 1):
        said(f"form {rank}", rank - 1, len(chosen))
        counts = len(form.starts), len(form.members)
        reports.append(report_form(form.best, rank, required, folder, *counts))
        for problem in reports[-1].problems:
            logger.warning("form %d: %s", rank, problem)
    said("page", len(chosen), len(chosen))
    pictures = Pictures(
        None if starts is None else starts.figure(),
        None if course is None else course_figure(course, merit_label),
    )
    figures = {"starts": pictures.starts, "merit_over_time": pictures.course}
    try:
        figures["forms"] = sections_figure(reports, title)
        for name, figure in figures.items():
            if figure is not None:
                save_figure(figure, folder / f"{name}.png")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
    write_page(reports, folder, title, facts, pictures, len(forms), merit_label)
    return tuple(reports)


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
