"""What a search has found: designs, their forms, and the tables, figures and page of these."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.experiment import Figures
from dolens.experiments.tables import Row
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs, designed_lens
from dolens.lens_search.form_report import FormReport, glasses_text, report_form
from dolens.lens_search.forms import FoundLens, distinct
from dolens.lens_search.glass.glass_merit import merit_of
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.page import Pictures, write_page
from dolens.lens_search.search import SearchPlan, Step, with_step
from dolens.lens_search.search_report import search_course, sections_figure, start_map
from dolens.lens_search.specification import Specification
from dolens.lens_search.verification import Requirements
from dolens.plotting.search import search_course_figure, starts_figure

_UM = 1e3


@dataclass(frozen=True)
class Course:
    """Times, merits and forms of all designs.

    Attributes:
        seconds: s, when each was known, (n,).
        merits: µm, (n,).
        forms: number of the form of each, (n,), from 0, the best.
        starts: number of the start of each, (n,).
    """

    seconds: Tensor
    merits: Tensor
    forms: Tensor
    starts: Tensor


class Finds:
    """Collects the steps of a search.

    Args:
        specification: of the search.
        plan: of the search.

    Attributes:
        found: the best forms as lenses, the best first; see `rank`.
        features: powers of the elements of every start, by the number of its batch's first start.
        iterations: of all lenses together.
    """

    def __init__(self, specification: Specification, plan: SearchPlan) -> None:
        self.specification, self.plan = specification, plan
        self.found: list[FoundLens] = []
        self.features: dict[int, Tensor] = {}
        self.iterations = 0
        self._pool: dict[Arrangement, Designs] = {}
        self._course: Course | None = None
        self._all: list[tuple[Designs, float]] = []
        self._snapped: list[tuple[float, float]] = []

    def add(self, step: Step, seconds: float) -> None:
        """Add a step that was known at a time."""
        self.iterations += step.iterations
        self._course = None
        if len(step.features):
            self.features[step.first] = step.features
        step = replace(step, designs=tuple(self._of_real_glasses(d) for d in step.designs))
        self._all += [(designs, seconds) for designs in step.designs if len(designs.values)]
        self._pool = with_step(self._pool, step, self.specification, self.plan)
        merits = [float(m) for designs in step.designs for m in designs.merit]
        if step.continuous is not None and merits:
            self._snapped.append((min(merits), step.continuous))

    def _of_real_glasses(self, designs: Designs) -> Designs:
        """Return the designs whose glasses exist: those still continuous are on their way."""
        merit = self._merit(designs.arrangement)
        return designs.chosen(merit.are_real(designs.values))

    def _merit(self, arrangement: Arrangement) -> SearchMerit:
        return merit_of(arrangement, self.specification, 1, 1)

    @property
    def glass_loss(self) -> float | None:
        """Return by what share the best form that was snapped has a greater mean RMS spot than
        with continuous glasses; None where none was.
        """
        if not self._snapped:
            return None
        real, continuous = min(self._snapped)
        return real / continuous - 1.0

    @property
    def has_map(self) -> bool:
        """Return whether starts can be laid out in a plane: those of a single element cannot."""
        return all(features.shape[1] > 1 for features in self.features.values())

    @property
    def designs(self) -> int:
        """Return how many designs keep the specification."""
        return sum(len(designs.values) for designs, _ in self._all)

    @property
    def merits(self) -> Tensor:
        """Return the mean RMS spots of all forms, µm, the best first."""
        parts = [designs.merit for designs in self._pool.values()]
        return _UM * torch.cat(parts or [torch.zeros(0)]).sort().values

    @property
    def forms(self) -> int:
        """Return how many different forms there are."""
        return len(self.merits)

    def forms_within(self, share: float) -> int:
        """Return how many forms are worse than the best by a share at most."""
        merits = self.merits
        return int((merits <= (1.0 + share) * merits[:1]).sum())

    def report(self) -> str:
        """Return a line for the log."""
        if not self.forms:
            return f"{self.iterations} iterations, no lens yet"
        return (
            f"best mean RMS spot {float(self.merits[0]):.3f} µm; {self.designs} lenses of "
            f"{self.forms} forms, {self.forms_within(0.25)} within 25 % of the best"
        )

    def rank(self, count: int) -> None:
        """Make lenses of the best forms; lenses that differ in the place of the stop alone are one
        form.
        """
        ranked = sorted(
            (float(merit), arrangement.stop, arrangement.within, row, arrangement)
            for arrangement, designs in self._pool.items()
            for row, merit in enumerate(designs.ranked_merit(self._merit(arrangement)))
        )
        lenses = []
        for merit, _, _, row, arrangement in ranked[: 2 * count]:
            designs = self._pool[arrangement]
            lens = designed_lens(
                arrangement, self.specification, designs.values[row], f"form {len(lenses) + 1}"
            )
            spots = tuple(_UM * float(spot) for spot in designs.spots[row])
            start = int(designs.starts[row])
            lenses.append(FoundLens(lens, _UM * merit, spots, start, designs.history[row]))
        self.found = self._distinct(lenses)[:count]

    def _distinct(self, lenses: list[FoundLens]) -> list[FoundLens]:
        """Return the best lens of each form, the best first."""
        if not self.plan.glass.apart:
            return [form.best for form in distinct(lenses)]
        of_glasses: dict[str, list[FoundLens]] = {}
        for found in lenses:
            of_glasses.setdefault(glasses_text(found.lens), []).append(found)
        forms = [form.best for alike in of_glasses.values() for form in distinct(alike)]
        return sorted(forms, key=lambda found: found.merit)

    def course(self) -> Course:
        """Return when each design was found, and its form; it is worked out once for a step."""
        if self._course is None:
            self._course = self._whole_course()
        return self._course

    def _whole_course(self) -> Course:
        seconds, merits, starts, numbers = [], [], [], []
        first = 0
        for arrangement in self._pool:
            mine = [(d, s) for d, s in self._all if d.arrangement == arrangement]
            designs = Designs.joined([d for d, _ in mine])
            own = designs.form_numbers(self._merit(arrangement), self.plan.glass.apart)
            numbers.append(own + first)
            first += int(own.max()) + 1
            merits.append(_UM * designs.merit)
            starts.append(designs.starts)
            seconds += [torch.full((len(d.values),), s) for d, s in mine]
        merit_of_all, form = torch.cat(merits), torch.cat(numbers)
        best = torch.full((first,), torch.inf, dtype=torch.float64)
        best = best.scatter_reduce(0, form, merit_of_all, "amin")
        place = torch.empty(first, dtype=torch.int64)
        place[best.argsort(stable=True)] = torch.arange(first)
        return Course(torch.cat(seconds), merit_of_all, place[form], torch.cat(starts))


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
