"""Figures of a search."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure

from dolens.experiments.experiment import Figures
from dolens.experiments.lens_search.finds import Finds
from dolens.lens_search.form_report import FormReport
from dolens.lens_search.search_report import search_course, sections_figure, start_map
from dolens.plotting.search import search_course_figure, starts_figure


def search_figures(finds: Finds, reports: Sequence[FormReport], name: str) -> Figures:
    """Return the sections of all forms, the search's course and the map of starts.

    Starts of a single element differ in nothing that a map could show, and have none.
    """
    if not finds.found:
        return {}
    found: dict[str, Callable[[], Figure]] = {"course": lambda: course_picture(finds, name)}
    if all(features.shape[1] > 1 for features in finds.features.values()):
        found["starts"] = lambda: starts_picture(finds, name)
    sections = sections_figure(reports, f"{name}: mean RMS spot of each form")
    return found if sections is None else {"forms": lambda: sections, **found}


def course_picture(finds: Finds, name: str) -> Figure:
    """Draw merit and forms against time."""
    course = finds.course()
    found = search_course(course.seconds.tolist(), course.merits.tolist(), course.forms.tolist())
    return search_course_figure(
        found.seconds, found.merits, found.best, found.forms, "mean RMS spot (µm)", title=name
    )


def starts_picture(finds: Finds, name: str) -> Figure:
    """Draw which start led where."""
    course = finds.course()
    firsts = sorted(finds.features)
    features = torch.cat([finds.features[first] for first in firsts])
    number_of = torch.cat([first + torch.arange(len(finds.features[first])) for first in firsts])
    reached = np.full(len(features), -1)
    places = {number: place for place, number in enumerate(number_of.tolist())}
    order = course.merits.argsort(descending=True)
    for row in order.tolist():
        place = places.get(int(course.starts[row]))
        if place is not None:
            reached[place] = int(course.forms[row])
    names = [f"φ{n}" for n in range(1, features.shape[1] + 1)]
    found = start_map(features, names)
    return starts_figure(
        found.points.numpy(),
        reached.tolist(),
        found.labels,
        len(features),
        title=f"{name}: which start led where",
    )
