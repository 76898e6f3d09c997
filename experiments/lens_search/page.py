"""The forms of a search are reported, one by one and on a page."""

from collections.abc import Sequence
from pathlib import Path

import torch

from dolens.experiments.lens_search.figures import course_picture, starts_picture
from dolens.experiments.lens_search.finds import Course, Finds
from dolens.lens_search.form_report import FormReport, report_form
from dolens.lens_search.forms import FoundLens
from dolens.lens_search.page import Pictures
from dolens.lens_search.search_report import write_page
from dolens.lens_search.specification import Specification
from dolens.lens_search.verification import Requirements


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
    pictures = Pictures(starts_picture(finds, name), course_picture(finds, name))
    write_page(
        reports, folder, name, _facts(finds.specification), pictures, finds.forms, "merit (µm)"
    )


def starts_and_designs(course: Course, found: FoundLens) -> tuple[int, int]:
    """Return how many starts and designs have the form of a found lens."""
    nearest = int((course.merits - found.merit).abs().argmin())
    same = course.forms == course.forms[nearest]
    return len(torch.unique(course.starts[same])), int(same.sum())


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
