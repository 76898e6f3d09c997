"""Tables, figures and the page of what a search has found."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from dolens.experiments.experiment import Figures
from dolens.experiments.tables import Row
from dolens.experiments.watch.history import Frame
from dolens.lens_search.finds import Finds, course_picture, starts_and_designs, starts_picture
from dolens.lens_search.form_report import FormReport, report_form
from dolens.lens_search.page import Pictures, write_page
from dolens.lens_search.search_report import sections_figure
from dolens.lens_search.specification import Specification
from dolens.lens_search.verification import Requirements
from dolens.prescriptions import prescription_of

RECORDED_FORMS = 6
"""Forms that a frame of the history has."""


def forms_frame(finds: Finds) -> Frame:
    """Return the best forms of a search as a frame of its run's history; see `Finds.rank`."""
    return Frame(
        0,
        0.0,
        forms=[
            {
                "merit": found.merit,
                "spots": list(found.rms_spot_um),
                "way": ", ".join(found.history),
                "lens": prescription_of(found.lens),
            }
            for found in finds.found[:RECORDED_FORMS]
        ],
    )


def form_rows(reports: Sequence[FormReport]) -> Iterator[Row]:
    """Yield a row for each form, the best first."""
    for report in reports:
        found, made, colour = report.found, report.sensitivity, report.colour
        spots = {f"rms_spot_um_{n}": spot for n, spot in enumerate(found.rms_spot_um, 1)}
        yield {
            "form": report.name,
            "powers": report.powers,
            "mean_rms_spot_um": found.mean_rms_spot_um,
            **spots,
            "rms_spot_um_90_percent_as_made": "" if made is None else made.ninety_percent_um,
            "worst_tolerance": "" if made is None else made.worst,
            "axial_colour_um": "" if colour is None else colour.axial_um,
            "secondary_spectrum_um": "" if colour is None else colour.secondary_um,
            "lateral_colour_um": "" if colour is None else colour.lateral_um,
            "holds": report.holds,
            "broken": report.broken,
            "glasses": report.glasses,
            "starts": report.starts,
            "designs": report.designs,
            "start": found.start,
            "history": ", ".join(found.history),
        }


def check_rows(reports: Sequence[FormReport]) -> Iterator[Row]:
    """Yield a row for each quantity of each form."""
    for report in reports:
        for check in report.verification.checks if report.verification else ():
            yield {
                "form": report.name,
                "quantity": check.name,
                "value": check.value,
                "unit": check.unit,
                "least": "" if check.least is None else check.least,
                "most": "" if check.most is None else check.most,
                "holds": "" if check.holds is None else check.holds,
                "place": check.place,
            }


def search_figures(finds: Finds, reports: Sequence[FormReport], name: str) -> Figures:
    """Return the sections of all forms, the search's course and the map of starts."""
    if not finds.found:
        return {}
    found: dict[str, Callable[[], Figure]] = {"course": lambda: course_picture(finds, name)}
    if finds.has_map:
        found["starts"] = lambda: starts_picture(finds, name)
    sections = sections_figure(reports, f"{name}: mean RMS spot of each form")
    return found if sections is None else {"forms": lambda: sections, **found}


def form_reports(finds: Finds, folder: Path) -> list[FormReport]:
    """Check the best forms of a search, and write their files to a folder."""
    required, course = Requirements.of(finds.specification), finds.course()
    return [
        report_form(found, number, required, folder, *starts_and_designs(course, found))
        for number, found in enumerate(finds.found, 1)
    ]


def write_forms_page(finds: Finds, reports: Sequence[FormReport], folder: Path, name: str) -> None:
    """Write `forms.html` to the folder of a run.

    Args:
        finds: of the search.
        reports: of its best forms.
        folder: of the run.
        name: of the experiment.
    """
    starts = starts_picture(finds, name) if finds.has_map else None
    pictures = Pictures(starts, course_picture(finds, name))
    write_page(
        reports, folder, name, _facts(finds.specification), pictures, finds.forms, "merit (µm)"
    )


def _facts(specification: Specification) -> list[tuple[str, str]]:
    """Return what was asked for, for the page's heading."""
    fields = ", ".join(f"{angle:g}°" for angle in specification.fields)
    waves = ", ".join(f"{wave:g}" for wave in specification.wavelengths)
    return [
        ("focal length", f"{specification.focal_length:g} mm"),
        ("F-number", f"{specification.f_number:g}"),
        ("fields", fields),
        ("wavelengths", f"{waves} nm"),
        ("elements", f"{specification.elements}"),
    ]
