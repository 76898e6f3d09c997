"""Figures of a search."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure

from dolens.experiments.experiment import Figures
from dolens.experiments.lens_search.finds import Finds
from dolens.lens_search.course import search_course
from dolens.lens_search.start_map import start_map
from dolens.lens_search.verification import Verification
from dolens.plotting.forms import FormPicture, form_section, forms_figure
from dolens.plotting.search_course import search_course_figure
from dolens.plotting.starts import starts_figure


def search_figures(finds: Finds, checked: Sequence[Verification], name: str) -> Figures:
    """Return the sections of all forms, the search's course and the map of starts."""
    if not finds.found:
        return {}
    return {
        "forms": lambda: _forms(finds, checked, name),
        "course": lambda: _course(finds, name),
        "starts": lambda: _starts(finds, name),
    }


def _forms(finds: Finds, checked: Sequence[Verification], name: str) -> Figure:
    pictures = []
    for number, (found, verification) in enumerate(zip(finds.found, checked, strict=True), 1):
        broken = ", ".join(check.name for check in verification.broken)
        pictures.append(
            FormPicture(
                form_section(found.lens), str(number), f"{found.mean_rms_spot_um:.2f} µm", broken
            )
        )
    return forms_figure(pictures, title=f"{name}: mean RMS spot of each form")


def _course(finds: Finds, name: str) -> Figure:
    course = finds.course()
    found = search_course(course.seconds.tolist(), course.merits.tolist(), course.forms.tolist())
    return search_course_figure(
        found.seconds, found.merits, found.best, found.forms, "mean RMS spot, µm", title=name
    )


def _starts(finds: Finds, name: str) -> Figure:
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
        found.points.numpy(), reached.tolist(), found.labels, len(features), title=name
    )
