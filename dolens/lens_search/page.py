"""The page of a search: its forms side by side at one scale, compared, checked, with their files.

It is one HTML file that needs no network; the prescriptions that it links to lie beside it.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup
from matplotlib.figure import Figure

from dolens.errors import InputError
from dolens.files import installed_version, written_whole
from dolens.html import rendered
from dolens.lens_page.markup import PAGE, Block, figure_html
from dolens.lens_page.tables import number
from dolens.lens_search.form_report import FormReport
from dolens.lens_search.verification import Check
from dolens.optics.fields import field_label
from dolens.plotting.export import laid_out
from dolens.plotting.small_sections import common_size, form_figure
from dolens.plotting.style import number_text, round_length

GENERATOR = "dolens search"
# The share of a section's width that the bar of its scale may take.
_BAR = 0.35


@dataclass(frozen=True, eq=False)
class Pictures:
    """Holds the pictures of a search; None where there is none.

    Attributes:
        starts: which start led where.
        course: merit and forms against time.
    """

    starts: Figure | None = None
    course: Figure | None = None


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
    blocks = [
        Block("forms", "Forms"),
        Block("comparison", "Comparison"),
        Block("checks", "Checks by real rays"),
    ]
    for name, heading, figure in (
        ("starts", "Which start led where", pictures.starts),
        ("course", "Course of the search", pictures.course),
    ):
        if figure is not None:
            with laid_out(figure):
                blocks.append(Block(name, heading, figures=[figure_html(figure, name, heading)]))
    blocks.append(Block("files", "Prescriptions"))
    sections = [report.section for report in reports if report.section is not None]
    width = common_size(sections)[0] if sections else 1.0
    scale = round_length(_BAR * width)
    page = rendered(
        Path(__file__).with_name("forms.html"),
        PAGE.parent,
        filters={"number": number, "address": lambda path: _address(path, folder)},
        title=title,
        facts=[
            *facts,
            ("forms", str(found)),
            ("best mean RMS spot", f"{number(reports[0].found.mean_rms_spot_um, 4)} µm"),
        ],
        command="",
        sections=blocks,
        generator=GENERATOR,
        version=installed_version("dolens") or "",
        reports=reports,
        found=found,
        cards=[(report, _section(report, width)) for report in reports],
        scale=f"{number_text(scale)} mm",
        scale_share=100.0 * scale / width,
        merit_label=merit_label,
        fields=_fields(reports[0]),
        checked=[report for report in reports if report.verification is not None],
        checks=_checks(reports),
        changes=_changes(reports),
    )
    try:
        with written_whole(folder / "forms.html") as aside:
            aside.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None


def _section(report: FormReport, width: float) -> Markup | None:
    """Draw the section of a form, at the scale of all."""
    if report.section is None:
        return None
    figure = form_figure(report.section, width, report.section.half_height)
    label = f"Section of form {report.number}: {report.powers}"
    return figure_html(figure, f"form{report.number}", label)


def _fields(report: FormReport) -> list[str]:
    """Return labels of the fields that spots are of; none where there are other fields."""
    fields = report.lens.fields
    if fields is None or len(fields.points) != len(report.found.rms_spot_um):
        return []
    unit = "°" if fields.kind == "angles" else "mm"
    return [field_label(point, unit) for point in fields.points]


def _checks(reports: Sequence[FormReport]) -> list[tuple[str, str, list[Check | None]]]:
    """Return each quantity, what is required of it, and what each form that was traced has."""
    of_forms = [
        {check.name: check for check in report.verification.checks}
        for report in reports
        if report.verification is not None
    ]
    rows = []
    for name in dict.fromkeys(name for own in of_forms for name in own):
        found = [own.get(name) for own in of_forms]
        first = next(check for check in found if check is not None)
        unit = f" ({first.unit})" if first.unit else ""
        rows.append((f"{name}{unit}", _limits(first), found))
    return rows


def _limits(check: Check) -> str:
    least, most = (None if v is None else number(v, 4) for v in (check.least, check.most))
    if least is not None and most is not None:
        return f"{least} to {most}"
    if least is not None:
        return f"≥ {least}"
    return "" if most is None else f"≤ {most}"


# A number in a sentence.
_NUMBER = re.compile(r"-?\d+\.\d+(e[-+]?\d+)?")


def _address(path: Path, folder: Path) -> str:
    """Return where a file lies, seen from a page in a folder."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())


def _changes(reports: Sequence[FormReport]) -> list[str]:
    """Return what formats say otherwise that cannot hold all of a form."""
    # A change that only differs in its number is one.
    notes: dict[str, dict[int, str]] = {}
    for report in reports:
        for file in report.files:
            for change in file.changes:
                note = f"{file.path.suffix}: {change}"
                notes.setdefault(_NUMBER.sub("…", note), {})[report.number] = note
    said = []
    for general, of in notes.items():
        alike = set(of.values())
        where = "" if len(of) == len(reports) else f" (form {', '.join(map(str, of))})"
        said.append((alike.pop() if len(alike) == 1 else general) + where)
    return said
