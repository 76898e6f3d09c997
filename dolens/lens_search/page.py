"""The page of a search: its forms side by side at one scale, compared, checked, with their files.

It is one HTML file that needs no network; the prescriptions that it links to lie beside it.
"""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from matplotlib.figure import Figure

from dolens.errors import InputError
from dolens.files import written_whole
from dolens.html import Child, Markup, element, joined, table
from dolens.lens_page.markup import Block, figure_html, inline_svg, page_html, problem_html
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
_YES, _NO = "✓", "✗"


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
    best = reports[0].found
    told = [
        *facts,
        ("forms", str(found)),
        ("best mean RMS spot", f"{number(best.mean_rms_spot_um, 4)} µm"),
    ]
    blocks = [
        Block("forms", "Forms", _cards(reports, found, folder)),
        Block("comparison", "Comparison", _comparison(reports, merit_label)),
        Block("checks", "Checks by real rays", _checks(reports)),
    ]
    for name, heading, figure in (
        ("starts", "Which start led where", pictures.starts),
        ("course", "Course of the search", pictures.course),
    ):
        if figure is not None:
            with laid_out(figure):
                svg = inline_svg(figure, name, heading)
            blocks.append(Block(name, heading, figure_html(svg, False)))
    blocks.append(Block("files", "Prescriptions", file_table(reports, folder)))
    page = page_html(title, told, "", blocks, STYLE, GENERATOR)
    try:
        with written_whole(folder / "forms.html") as aside:
            aside.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None


def _cards(reports: Sequence[FormReport], found: int, folder: Path) -> Markup:
    """Return the sections side by side, each with what matters about it."""
    sections = [report.section for report in reports if report.section is not None]
    width = common_size(sections)[0] if sections else 1.0
    note = "All sections are drawn to one scale, with rays of the fields through the whole stop."
    if found > len(reports):
        note += f" These are the best {len(reports)} of {found} forms."
    cards = (_card(report, width, folder) for report in reports)
    return joined(element("p", note), element("div", *cards, class_="cards"))


def _card(report: FormReport, width: float, folder: Path) -> Markup:
    best = report.found
    mark = element("span", f"{_YES} keeps all", class_="good") if report.holds else None
    if mark is None:
        mark = element("span", f"{_NO} {report.broken}", class_="bad")
    drawn: Child = None
    if report.section is not None:
        figure = form_figure(report.section, width, report.section.half_height)
        label = f"Section of form {report.number}: {report.powers}"
        svg = inline_svg(figure, f"form{report.number}", label)
        length = round_length(_BAR * width)
        bar = element(
            "div",
            f"{number_text(length)} mm",
            class_="bar",
            style=f"width:{100.0 * length / width:.2f}%",
        )
        drawn = joined(figure_html(svg, False), bar)
    rows = [("RMS spots", _spots(report)), ("glasses", report.glasses)]
    if report.sensitivity is not None:
        rows.append(
            ("90 % as made", f"≤ {number(report.sensitivity.ninety_percent_um, 3, zeros=True)} µm")
        )
    if report.starts is not None and report.designs is not None:
        starts, designs = (
            f"{count} {word}{'s' * (count != 1)}"
            for word, count in (("start", report.starts), ("design", report.designs))
        )
        rows.append(("from", f"{starts}, {designs}"))
    if len(best.history) > 1:
        rows.append(("way", ", ".join(best.history)))
    facts = (joined(element("dt", name), element("dd", value)) for name, value in rows)
    links = [
        element("a", file.path.suffix, href=address(file.path, folder))
        for file in report.files
        if file.written
    ]
    return element(
        "article",
        element(
            "h3",
            element("b", str(report.number)),
            element("span", f"{number(best.mean_rms_spot_um, 3, zeros=True)} µm"),
            element("span", report.powers, class_="powers"),
            mark,
        ),
        drawn,
        *map(problem_html, report.problems),
        element("dl", *facts),
        element("p", *links, class_="links"),
        class_="card",
        id=f"form-{report.number}",
    )


def _spots(report: FormReport) -> str:
    best = report.found
    return ", ".join(number(value, 3, zeros=True) for value in best.rms_spot_um) + " µm"


def _comparison(reports: Sequence[FormReport], merit_label: str) -> Markup:
    """Return the forms row by row."""
    lens = reports[0].lens
    labels: list[str] = []
    if lens.fields is not None:
        unit = "°" if lens.fields.kind == "angles" else "mm"
        labels = [field_label(point, unit) for point in lens.fields.points]
    spots = labels if len(labels) == len(reports[0].found.rms_spot_um) else []
    heads = ("#", "powers", merit_label, "mean", *spots, "track", "back focus", "distortion")
    heads += ("chief ray", "expected", "90 %", "worst tolerance", "checks")
    rows = []
    for report in reports:
        best, sensitivity = report.found, report.sensitivity
        shown = best.rms_spot_um if len(best.rms_spot_um) == len(spots) else [math.nan] * len(spots)
        values = [number(value, 4, zeros=True) for value in (best.merit, best.mean_rms_spot_um)]
        values += [number(value, 3, zeros=True) for value in shown]
        values += [
            _value(report, name)
            for name in ("total track", "back focus", "distortion", "chief-ray angle")
        ]
        made = ["–", "–", "–"]
        if sensitivity is not None:
            made = [
                number(sensitivity.expected_um, 3, zeros=True),
                number(sensitivity.ninety_percent_um, 3, zeros=True),
                f"{sensitivity.worst} ({100.0 * sensitivity.worst_share:.0f} %)",
            ]
        kept: Child = element("span", _YES, class_="good")
        if not report.holds:
            kept = element("span", f"{_NO} {report.broken}", class_="bad")
        link = element("a", str(report.number), href=f"#form-{report.number}")
        rows.append([link, report.powers, *values, *made, kept])
    words = dict.fromkeys((1, len(heads) - 2, len(heads) - 1), "words")
    caption = (
        "RMS spot radii in µm: their mean over the fields, of each field, and with tolerances: the "
        "root of the mean square expected over lenses as made, and what 90 % of them stay within, "
        "refocused (linear ray model). Lengths in mm, distortion in % of f·tan θ, the angle of the "
        "steepest chief ray at the sensor in degrees."
    )
    known = [report.sensitivity for report in reports if report.sensitivity is not None]
    if known:
        caption += f" {known[0].tolerances}"
    return joined(
        element("div", table(heads, rows, column_kinds=words), class_="scroll"),
        element("p", caption, class_="caption"),
    )


def _value(report: FormReport, name: str) -> str:
    if report.verification is None:
        return "–"
    return number(report.verification.value(name), 4)


def _checks(reports: Sequence[FormReport]) -> Markup:
    """Return one quantity a row, one form a column."""
    checked = [report for report in reports if report.verification is not None]
    if not checked:
        return problem_html("no form could be traced")
    names = list(
        dict.fromkeys(
            check.name
            for report in checked
            if report.verification is not None
            for check in report.verification.checks
        )
    )
    rows = []
    for name in names:
        found = [_check(report, name) for report in checked]
        first = next(check for check in found if check is not None)
        unit = f" ({first.unit})" if first.unit else ""
        rows.append([f"{name}{unit}", _limits(first), *map(_cell, found)])
    heads = ("quantity", "required", *(str(report.number) for report in checked))
    caption = (
        "Real rays of 21 field heights and every wavelength, through the physical stop; "
        "thicknesses are taken out to where the beams end. A red value is not kept, to a "
        "thousandth; pointing at it says where that is."
    )
    kinds = {0: "words", 1: "words"}
    return joined(
        element("div", table(heads, rows, column_kinds=kinds), class_="scroll"),
        element("p", caption, class_="caption"),
    )


def _check(report: FormReport, name: str) -> Check | None:
    if report.verification is None:
        return None
    return next((check for check in report.verification.checks if check.name == name), None)


def _limits(check: Check) -> str:
    least, most = (None if v is None else number(v, 4) for v in (check.least, check.most))
    if least is not None and most is not None:
        return f"{least} to {most}"
    if least is not None:
        return f"≥ {least}"
    return "" if most is None else f"≤ {most}"


def _cell(check: Check | None) -> Markup:
    if check is None:
        return element("span", "–")
    kind = "bad" if check.holds is False else None
    # What rounding leaves of zero is zero.
    value = 0.0 if abs(check.value) < 1e-9 else check.value
    return element("span", number(value, 4), class_=kind, title=check.place or None)


_MISSING = "✗ not written"
# A number in a sentence.
_NUMBER = re.compile(r"-?\d+\.\d+(e[-+]?\d+)?")


def address(path: Path, folder: Path) -> str:
    """Return where a file lies, seen from a page in a folder."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())


def file_table(reports: Sequence[FormReport], folder: Path) -> Markup:
    """Return which formats hold each form, and what those say otherwise that cannot hold all."""
    suffixes = [file.path.suffix for file in reports[0].files]
    rows: list[list[Child]] = []
    # A change that only differs in its number is one.
    notes: dict[str, dict[int, str]] = {}
    for report in reports:
        row: list[Child] = [report.name]
        for file in report.files:
            if not file.written:
                row.append(element("span", _MISSING, class_="bad"))
            else:
                mark = "" if file.exact else " ≈"
                name = f"{file.path.suffix}{mark}"
                row.append(element("a", name, href=address(file.path, folder)))
            for change in file.changes:
                note = f"{file.path.suffix}: {change}"
                notes.setdefault(_NUMBER.sub("…", note), {})[report.number] = note
        rows.append(row)
    kinds = dict.fromkeys(range(len(suffixes) + 1), "words")
    said = []
    for general, of in notes.items():
        alike = set(of.values())
        where = "" if len(of) == len(reports) else f" (form {', '.join(map(str, of))})"
        said.append(element("li", (alike.pop() if len(alike) == 1 else general) + where))
    caption = "Every file was read again: it gives the same numbers to the last bit, but for ≈."
    return joined(
        element("div", table(("form", *suffixes), rows, column_kinds=kinds), class_="scroll"),
        element("p", caption, class_="caption"),
        element("ul", *said, class_="notes") if said else None,
    )


STYLE = """
:root { --good: #1a7f4b; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --good: #63c993; --bad: #ff8a80; } }
.page { grid-template-columns: 11rem minmax(0, 90rem); max-width: 106rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(21rem, 1fr)); gap: 1rem; }
.card { display: flex; flex-direction: column; border: 1px solid var(--line); border-radius: .5rem;
  padding: .7rem .9rem; min-width: 0; scroll-margin-top: 1rem; }
.card:target { border-color: var(--accent); }
.card h3 { display: flex; flex-wrap: wrap; gap: .2rem .8rem; align-items: baseline;
  margin: 0 0 .6rem; color: var(--ink); font-weight: 400; }
.card h3 b { font-size: 1.15rem; font-weight: 650; }
.card .powers { font-variant-numeric: tabular-nums; letter-spacing: .06em; }
.card figure { margin-top: auto; }
.card figure svg { max-width: none !important; }
.card .bar { border-top: 2px solid currentColor; font-size: .75rem; color: var(--soft);
  margin: .3rem 0 .5rem; padding-top: .1rem; white-space: nowrap; }
.card dl { display: grid; grid-template-columns: auto 1fr; gap: .05rem .8rem; margin: 0;
  font-size: .85rem; font-variant-numeric: tabular-nums; }
.card dt { color: var(--soft); }
.card dd { margin: 0; overflow-wrap: anywhere; }
.links { display: flex; gap: .7rem; margin: .5rem 0 0; font-size: .85rem; }
.good { color: var(--good); } .bad { color: var(--bad); font-weight: 600; }
a { color: var(--accent); }
.notes { color: var(--soft); font-size: .85rem; padding-left: 1.1rem; }
@media (max-width: 60rem) { .page { grid-template-columns: minmax(0, 1fr); } }
"""
