"""What a search has found: designs, their forms as lenses, and pictures of its course."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs, designed_lens
from dolens.lens_search.form_report import glasses_text
from dolens.lens_search.forms import FoundLens, distinct
from dolens.lens_search.glass.glass_merit import merit_of
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.search import SearchPlan, Step, with_step
from dolens.lens_search.search_report import search_course, start_map
from dolens.lens_search.specification import Specification
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
        lenses: list[FoundLens] = []
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


def starts_and_designs(course: Course, found: FoundLens) -> tuple[int, int]:
    """Return how many starts and designs have the form of a found lens."""
    nearest = int((course.merits - found.merit).abs().argmin())
    same = course.forms == course.forms[nearest]
    return len(torch.unique(course.starts[same])), int(same.sum())
