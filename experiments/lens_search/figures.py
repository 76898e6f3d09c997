"""Figures of a search."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from dolens.experiments.experiment import Figures
from dolens.experiments.lens_search.finds import Finds
from dolens.lens_search.form_report import FormReport
from dolens.plotting.forms import FormPicture, forms_figure
from dolens.plotting.search_course import search_course_figure
from dolens.plotting.starts import starts_figure


def search_figures(finds: Finds, reports: Sequence[FormReport], name: str) -> Figures:
    """Return the sections of all forms, the search's course and the map of starts."""
    if not reports:
        return {}
    return {
        "forms": lambda: _forms(reports, name),
        "merit_over_time": lambda: _course(finds, name),
        "starts": lambda: _starts(finds, name),
    }


def _forms(reports: Sequence[FormReport], name: str) -> Figure:
    pictures = [
        FormPicture(
            report.section,
            str(report.number),
            f"{report.form.best.mean_rms_spot_um:.2f} µm    {report.powers}",
            report.broken,
        )
        for report in reports
        if report.section is not None
    ]
    return forms_figure(pictures, title=f"{name}: mean RMS spot of each form")


def _course(finds: Finds, name: str) -> Figure:
    found = finds.course()
    return search_course_figure(
        found.seconds, found.merits, found.best, found.forms, "mean RMS spot, µm", title=name
    )


def _starts(finds: Finds, name: str) -> Figure:
    found = finds.starts()
    return starts_figure(
        found.map.points.numpy(), found.forms.tolist(), found.map.labels, found.tried, title=name
    )
